"""`MemoryIndex`: rows and codes of chunks in this worker's memory or in mapped files."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from uuid import UUID

from services.search.catalog_sync import sync_snapshot
from services.search.chunk_loader import list_generation_folders, remove_stale_folders
from services.search.executor import SearchOptions, execute_query
from services.search.photo_columns import build_row_mask
from services.search.query_batcher import QueryBatcher
from services.search.residency import MemoryBudget
from services.search.snapshot import Snapshot
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage import ObjectStore
from shared.storage.chunks import Row
from shared.storage.read_retries import ReadRetries

FILE_CHECK_SECONDS = 5.0  # interval of the checks whether mapped files were changed


class MemoryIndex:
    """A `RowIndex` of everything that this worker holds."""

    changes_alone = False
    recalls: Mapping[UUID, float] = {}

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        unreadable: ReadRetries,
        batcher: QueryBatcher,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._folder = settings.search_cache_folder
        self._batcher = batcher
        self._memory_budget = MemoryBudget(settings.search_memory_bytes)
        self._unreadable = unreadable
        self._files_due: dict[UUID, float] = {}  # next check of each generation's files

    def sync(self, generation_id: UUID, old: Snapshot | None) -> Snapshot | None:
        """Load new chunks, drop removed ones, and apply changes of photos."""
        return sync_snapshot(
            self._catalog,
            self._store,
            self._folder,
            self._memory_budget,
            generation_id,
            old,
            self._unreadable,
        )

    def needs_sync(self, snapshot: Snapshot) -> bool:
        """Whether a missing chunk is due for a retry, or a mapped file was changed."""
        if self._unreadable.any_due(snapshot.missing):
            return True
        now = time.monotonic()
        if now < self._files_due.get(snapshot.generation_id, 0.0):
            return False
        self._files_due[snapshot.generation_id] = now + FILE_CHECK_SECONDS
        return any(chunk.was_changed() for chunk in snapshot.chunks)

    def search(self, snapshot: Snapshot, query: Row, request: SearchRequest) -> SearchResponse:
        """Scan the rows that pass the filter."""
        row_mask = build_row_mask(snapshot.photos, request.photos, request.exclude)
        options = SearchOptions(request.k, request.mode)
        return execute_query(snapshot, query, row_mask, options, self._batcher)

    def list_held(self) -> Sequence[Path]:
        """Return the cache folders."""
        return list_generation_folders(self._folder)

    def remove_others(self, held: Sequence[Path], generation_ids: Collection[UUID]) -> None:
        """Delete the cache folders, and release the memory, of other generations."""
        self._memory_budget.release_others(generation_ids)
        self._files_due = {k: v for k, v in self._files_due.items() if k in generation_ids}
        remove_stale_folders(held, generation_ids)
