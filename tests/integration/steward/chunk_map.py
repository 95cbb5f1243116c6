"""A map whose chunks and objects a test lays out."""

from __future__ import annotations

import os
import time
from typing import Any
from uuid import UUID

from sqlalchemy import select, update

from services.steward.tasks.compaction import merge_small_chunks
from shared.catalog.chunks import Descriptor, count_searchable, list_live_chunks
from shared.catalog.database.session import Catalog
from shared.catalog.maps import Map
from shared.config.settings import Settings
from shared.storage import FolderStore
from shared.storage.chunks import features_key
from shared.storage.feature_files import FeatureRows, read_feature_file
from shared.storage.keys import TRASH
from shared.storage.read_retries import ReadRetries
from tests.integration.harness import same
from tests.support.catalog_rows import (
    add_chunk,
    add_generation,
    add_map,
    add_photo,
    delete,
    merge_all,
    row_of,
    stored_rows,
)

HOUR_SECONDS = 3600.0
DAY_SECONDS = 86_400.0
MANY = 100  # small chunks that there may be before it is worth merging


Features = tuple[str, list[bytes]] | None
"""Model and rows of a feature file; None without."""


class ChunkMap:
    """A map with an active generation whose chunks the test lays out."""

    def __init__(self, catalog: Catalog, store: FolderStore) -> None:
        self.catalog, self.store = catalog, store
        with catalog.write() as session:
            self.map_id = add_map(session).id
            self.generation_id = add_generation(session, self.map_id).id

    def photos(self, count: int) -> list[UUID]:
        with self.catalog.write() as session:
            return [add_photo(session, self.map_id).id for _ in range(count)]

    def chunks(self, *sizes: int) -> list[list[UUID]]:
        """Publish chunks of these many photos; the photos of each."""
        made = [self.photos(size) for size in sizes]
        for photo_ids in made:
            add_chunk(self.catalog, self.store, self.generation_id, photo_ids)
        return made

    def chunks_with_features(self, *features: Features) -> list[list[UUID]]:
        """Publish a chunk of two photos for each of the features; the photos of each."""
        made = [self.photos(2) for _ in features]
        for photo_ids, rows in zip(made, features, strict=True):
            stored = rows and FeatureRows(*rows)
            add_chunk(self.catalog, self.store, self.generation_id, photo_ids, features=stored)
        return made

    def features(self) -> Features:
        """The model and the rows of the feature file of the only live chunk."""
        with self.catalog.read() as session:
            (chunk,) = list_live_chunks(session, self.generation_id)
        if chunk.features_model is None:
            return None
        key = features_key(chunk.object_key)
        stored = read_feature_file(self.store, key, chunk.features_sha256)
        assert sum(map(bool, stored.rows)) == chunk.features_rows
        return stored.model, [bytes(row) for row in stored.rows]

    def delete(self, *photo_ids: UUID) -> None:
        for photo_id in photo_ids:
            delete(self.catalog, self.map_id, photo_id)

    def merge(
        self, compact_chunks: int = MANY, retries: ReadRetries | None = None, chunk_rows: int = 1000
    ) -> int:
        """One round of the steward's merging; how many chunks it has written or dropped."""
        settings = Settings(chunk_rows=chunk_rows)
        return merge_small_chunks(self.catalog, self.store, settings, compact_chunks, retries)

    def merge_all(self) -> bool:
        return merge_all(self.catalog, self.store, self.generation_id)

    def live(self) -> list[int]:
        """The rows of each live chunk, oldest first."""
        with self.catalog.read() as session:
            return [chunk.rows for chunk in list_live_chunks(session, self.generation_id)]

    def check_rows(self, expected: list[UUID]) -> None:
        """The generation holds these photos, each with its own descriptor, and no others."""
        rows = stored_rows(self.catalog, self.store, self.generation_id)
        assert set(rows) == set(expected)
        assert all(same(row, row_of(photo_id)) for photo_id, row in rows.items())
        with self.catalog.read() as session:
            assert count_searchable(session, self.generation_id) == len(expected)
            pointed_at = set(session.scalars(select(Descriptor.chunk_id)))
            assert pointed_at <= {c.id for c in list_live_chunks(session, self.generation_id)}

    def version(self) -> int:
        with self.catalog.read() as session:
            return session.get_one(Map, self.map_id).version

    def change(self, table: type[Any], row_id: UUID, **columns: Any) -> None:
        with self.catalog.write() as session:
            session.execute(
                update(table)
                .where(table.id == row_id)
                .values(**columns)
                .execution_options(synchronize_session=False)
            )

    def objects(self, prefix: str = "") -> set[str]:
        return {
            info.key for info in self.store.list(prefix) if prefix or not info.key.startswith(TRASH)
        }

    def age(self, keys: set[str], seconds: float) -> None:
        then = time.time() - seconds
        for key in keys:
            os.utime(self.store.path(key), (then, then))
