"""A small map whose searches are compared with brute force."""

from __future__ import annotations

from collections.abc import Callable, Collection
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from shared.catalog.chunks import Chunk, Descriptor, list_live_chunks
from shared.catalog.database.session import Catalog
from shared.catalog.generations import RowType
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.photos import Photo
from shared.ids import new_id
from shared.search_api.photo_filter import PhotoFilter
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage import ObjectStore
from shared.storage.chunks import encode_rows
from tests.support.catalog_rows import (
    add_chunk,
    add_generation,
    add_map,
    delete,
    made_up_photo,
    merge_all,
)

DIMENSION = 12
NOON = datetime(2024, 5, 6, 12, tzinfo=UTC)
HOUR = timedelta(hours=1)
Rows = NDArray[np.float32]
Reference = tuple[str, int]
"""A descriptor: object key and row."""


def unit_rows(seed: int, count: int, dimension: int = DIMENSION) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, dimension))
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


class SmallMap:
    """A map with one generation, changed as the extractor, the gateway and the steward do.

    `rows` holds the expected state: every live photo with its descriptor.
    """

    def __init__(
        self, catalog: Catalog, store: ObjectStore, row_type: RowType = RowType.FLOAT32
    ) -> None:
        self.catalog = catalog
        self.store = store
        self.row_type = row_type
        self.rows: dict[UUID, Rows] = {}
        with catalog.write() as session:
            self.map_id = add_map(session, f"map-{new_id()}").id
            self.generation_id = add_generation(
                session, self.map_id, dimension=DIMENSION, row_type=row_type
            ).id

    @property
    def version(self) -> int:
        with self.catalog.read() as session:
            return session.get_one(Map, self.map_id).version

    def add(
        self,
        rows: Rows,
        dead: int = 0,
        about: Callable[[int], dict[str, Any]] = lambda row: {},
    ) -> list[UUID]:
        """Publish a chunk of photos; its first `dead` rows belong to no photo (a lease was lost).

        `about` returns the columns of `Photo` for a row.
        """
        with self.catalog.write() as session:
            photos = [Photo(**made_up_photo(self.map_id, **about(n))) for n in range(len(rows))]
            session.add_all(photos)
            photo_ids = [photo.id for photo in photos]
        stored = rows.astype(self.row_type)
        add_chunk(
            *(self.catalog, self.store, self.generation_id, photo_ids),
            rows=stored,
            dead=dead,
        )
        self.rows |= dict(list(zip(photo_ids, stored.astype(np.float32), strict=True))[dead:])
        return photo_ids

    def patch(self, photo_id: UUID, **columns: Any) -> None:
        """As `PATCH /uploads/{file_id}` does it."""
        with self.catalog.write() as session:
            lock_map(session, self.map_id)
            photo = session.get_one(Photo, photo_id)
            for name, value in columns.items():
                setattr(photo, name, value)
            photo.changed_version = increment_map_version(session, self.map_id)

    def delete(self, photo_id: UUID) -> None:
        delete(self.catalog, self.map_id, photo_id)
        del self.rows[photo_id]

    def merge(self) -> bool:
        return merge_all(self.catalog, self.store, self.generation_id)

    def chunk_keys(self) -> list[str]:
        with self.catalog.read() as session:
            return [chunk.object_key for chunk in list_live_chunks(session, self.generation_id)]

    def references(self) -> dict[UUID, Reference]:
        """The row of each photo in the generation."""
        with self.catalog.read() as session:
            found = session.execute(
                select(Descriptor.photo_id, Chunk.object_key, Descriptor.row)
                .join(Chunk, Chunk.id == Descriptor.chunk_id)
                .where(Descriptor.generation_id == self.generation_id)
            )
            return {photo_id: (key, row) for photo_id, key, row in found}

    def reference(self, photo_id: UUID) -> Reference:
        return self.references()[photo_id]

    def query(self, vector: Rows) -> Reference:
        """Store a query's descriptor, as a `describe` job does."""
        key = f"queries/{new_id()}.npy"
        self.store.put(key, encode_rows(vector[np.newaxis]))
        return key, 0

    def request(
        self,
        reference: Reference,
        k: int = 10,
        min_version: int | None = None,
        exclude: tuple[UUID, ...] = (),
        **photos: Any,
    ) -> SearchRequest:
        """`photos` are the filter's conditions."""
        return SearchRequest(
            generation_id=self.generation_id,
            object_key=reference[0],
            row=reference[1],
            min_version=self.version if min_version is None else min_version,
            k=k,
            photos=PhotoFilter(**photos),
            exclude=exclude,
        )

    def brute_force(
        self, vector: Rows, k: int = 10, among: Collection[UUID] | None = None
    ) -> list[tuple[UUID, float]]:
        exact = vector.astype(np.float64)
        exact /= np.linalg.norm(exact)
        scored = [(-float(row.astype(np.float64) @ exact), p) for p, row in self.rows.items()]
        if among is not None:
            scored = [(score, photo_id) for score, photo_id in scored if photo_id in among]
        return [(photo_id, -score) for score, photo_id in sorted(scored)[:k]]


def assert_answers(response: SearchResponse, expected: list[tuple[UUID, float]]) -> None:
    assert [hit.photo_id for hit in response.hits] == [photo_id for photo_id, _ in expected]
    np.testing.assert_allclose(
        [hit.score for hit in response.hits], [score for _, score in expected], atol=1e-12
    )


def damaged(whole: bytes, damage: str) -> bytes:
    if damage == "truncated":
        return whole[:-5]
    return whole[:-1] + bytes([whole[-1] ^ 1])
