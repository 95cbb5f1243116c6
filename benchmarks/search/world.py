"""A map as the services keep it: a catalog, a store, chunks of 1,000 rows, photos."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from uuid import UUID

import numpy as np
from sqlalchemy import insert

from services.search.follow import MIN_CODED_BYTES
from services.steward.compact import merge_slot
from shared.catalog.chunks import Chunk, Descriptor, list_live_chunks
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map, create_map, increment_map_version, lock_map
from shared.catalog.models import get_or_create_model
from shared.catalog.photos import Photo, mark_photo_deleted
from shared.catalog.schema import migrate
from shared.catalog.session import Catalog
from shared.chunks import Row, Rows, encode_rows, write_chunk
from shared.codes.rotation import get_rotation
from shared.ids import new_id
from shared.objects import FolderStore
from shared.search_protocol import SearchRequest
from shared.settings import Settings

CHUNK_ROWS = 1000


@dataclass(slots=True)
class SyntheticMap:
    """One map in a folder, changed as the extractor, the gateway and the steward change it."""

    settings: Settings
    catalog: Catalog
    store: FolderStore
    map_id: UUID
    generation_id: UUID
    dimension: int
    photo_ids: list[UUID] = field(default_factory=list)
    """In the order in which they were added; those that were deleted, too."""

    @property
    def version(self) -> int:
        """The map's, now."""
        with self.catalog.read() as session:
            return session.get_one(Map, self.map_id).version

    def add(self, rows: Rows, slot: int | None = None) -> int:
        """Publish a chunk of new photos, in a slot of its own unless one is named; the version
        that has them."""
        chunk_id, photo_ids = new_id(), [new_id() for _ in rows]
        written = write_chunk(
            self.store,
            generation_id=self.generation_id,
            chunk_id=chunk_id,
            rows=rows,
            photo_ids=photo_ids,
            spec={},
        )
        photos = [self._photo(photo_id) for photo_id in photo_ids]
        with self.catalog.write() as session:
            lock_map(session, self.map_id)
            session.execute(insert(Photo), photos)
            session.add(
                Chunk(
                    id=chunk_id,
                    generation_id=self.generation_id,
                    slot=len(self.photo_ids) // CHUNK_ROWS if slot is None else slot,
                    object_key=written.object_key,
                    rows=written.rows,
                    size_bytes=written.size_bytes,
                    sha256=written.sha256,
                )
            )
            session.flush()
            session.execute(
                insert(Descriptor),
                [
                    {
                        "generation_id": self.generation_id,
                        "photo_id": photo_id,
                        "chunk_id": chunk_id,
                        "row": row,
                    }
                    for row, photo_id in enumerate(photo_ids)
                ],
            )
            version = increment_map_version(session, self.map_id)
        self.photo_ids += photo_ids
        return version

    def delete(self, photo_id: UUID) -> int:
        """The version from which on the photo is gone."""
        with self.catalog.write() as session:
            lock_map(session, self.map_id)
            version = increment_map_version(session, self.map_id)
            mark_photo_deleted(session, session.get_one(Photo, photo_id), version)
        return version

    def merge(self, slot: int) -> bool:
        """Write the slot's chunks into one, as the steward does."""
        return merge_slot(self.catalog, self.store, self.generation_id, slot)

    def chunk_paths(self) -> list[Path]:
        """The files of the live chunks."""
        with self.catalog.read() as session:
            keys = [chunk.object_key for chunk in list_live_chunks(session, self.generation_id)]
        return [self.store.path(key) for key in keys]

    def request(
        self, object_key: str, k: int, min_version: int, min_score: float | None = None
    ) -> SearchRequest:
        """A question with a row that `ask_with` has stored."""
        return SearchRequest(
            map_id=self.map_id,
            generation_id=self.generation_id,
            object_key=object_key,
            row=0,
            min_version=min_version,
            k=k,
            min_score=min_score,
        )

    def store_query(self, row: Row) -> str:
        """Store a query's descriptor, as a `describe` job does; its key."""
        key = f"queries/{new_id()}.npy"
        self.store.put(key, encode_rows(row[np.newaxis]))
        return key

    def _photo(self, photo_id: UUID) -> dict[str, object]:
        return {
            "id": photo_id,
            "map_id": self.map_id,
            "sha256": photo_id.hex * 2,
            "object_key": f"originals/{photo_id}",
            "filename": "photo.jpg",
            "media_type": "image/jpeg",
            "size_bytes": 1,
            "width": 1,
            "height": 1,
        }


@contextlib.contextmanager
def create_synthetic_map(
    home: Path, dimension: int, *, search_memory_budget: int
) -> Iterator[SyntheticMap]:
    """An empty map in the folder `home`, in a SQLite catalog."""
    chosen = Settings(
        _env_file=None, placewise_home=home, search_memory_budget=search_memory_budget
    )
    home.mkdir(parents=True, exist_ok=True)
    catalog = Catalog(chosen.catalog_url())
    try:
        migrate(catalog)
        with catalog.write() as session:
            map_id = create_map(session, "default", "test-tiny-avg").id
            generation = Generation(
                id=new_id(),
                map_id=map_id,
                state=GenerationState.ACTIVE,
                extractor="test-tiny-avg",
                spec={"clusters": None},
                spec_fingerprint="0" * 64,
                dimension=dimension,
                model_id=get_or_create_model(session, "bench", "0" * 64, "MIT", {}).id,
            )
            session.add(generation)
        store = FolderStore(home / "objects")
        world = SyntheticMap(chosen, catalog, store, map_id, generation.id, dimension)
        yield world
    finally:
        catalog.close()


def required_memory_bytes(photos: int, dimension: int) -> int:
    """SEARCH_MEMORY_BUDGET for the codes of so many photos, or their rows where search does
    without codes; other rows stay mapped files."""
    return max(photos * get_rotation(dimension).padded // 8, MIN_CODED_BYTES)
