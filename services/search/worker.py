"""Search worker: `SearchBackend` in process, on snapshots that are swapped atomically.

`SearchWorker` keeps a snapshot of each generation in sync with the catalog and runs queries on the
current one. `QueryRowReader` reads the row that a query refers to, which may lie in a chunk that
has been merged since, or under `queries/`. It caches stored rows: the gateway asks for more hits of
the same query, and evaluations use the same photos again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Collection, Sequence
from concurrent import futures
from typing import Any
from uuid import UUID

import numpy as np
from cachetools import LRUCache
from sqlalchemy.exc import SQLAlchemyError

from services.search.catalog_sync import (
    SYNCED_STATES,
    ReplicationLagTracker,
    read_generation_versions,
    sync_snapshot,
)
from services.search.chunk_loader import MemoryBudget, list_generation_folders, remove_stale_folders
from services.search.executor import execute_query
from services.search.photo_columns import build_row_mask
from services.search.photo_matcher import PhotoMatcher
from services.search.pose_estimator import PoseEstimator
from services.search.query_batcher import QueryBatcher
from services.search.snapshot import Snapshot
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import Catalog, ChangePoll
from shared.catalog.generations import GenerationState
from shared.config.settings import Settings
from shared.errors import Gone, Misconfigured, NotFound, Unavailable
from shared.search_api.background import subtract_background
from shared.search_api.protocol import (
    MatchRequest,
    MatchResponse,
    PoseRequest,
    PoseResponse,
    RowReference,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.storage import ObjectStore
from shared.storage.chunks import Row, read_row, rows_are_valid
from shared.storage.keys import QUERIES
from shared.storage.read_retries import ReadRetries

log = logging.getLogger(__name__)

CACHED_ROW_BYTES = 75_000_000  # 190 rows of 98,304 dimensions


class QueryRowReader:
    """Reads query rows from memory or from the object store; thread-safe."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._cache: LRUCache[RowReference, Row] = LRUCache(
            CACHED_ROW_BYTES, getsizeof=lambda row: row.nbytes
        )

    def read_query(self, snapshot: Snapshot, request: SearchRequest) -> Row:
        """Return the (dimension,) row that a request refers to.

        Raises:
            Gone: `query_expired` if the row no longer exists.
            Unavailable: `chunk_unreadable` if the row's object is damaged.
        """
        chunk = snapshot.by_key.get(request.object_key)
        if request.object_key in snapshot.missing and not snapshot.disk_full:
            raise _unreadable_error(request.object_key)
        if chunk is None:
            reference = RowReference(object_key=request.object_key, row=request.row)
            if request.object_key.startswith(QUERIES):  # expires with its object
                return self._read(reference)
            return self._read_cached(reference)
        if request.row >= len(chunk.rows):
            raise _reference_expired_error(f"row {request.row} of {request.object_key}")
        row: Row = chunk.rows[request.row].astype(np.float32)
        return row

    def read_background(self, references: Sequence[RowReference]) -> list[Row]:
        """Return the rows of a background that still exist.

        They are cached: successive frames of a track share their background.
        """
        rows = []
        for reference in references:
            try:
                rows.append(self._read_cached(reference))
            except Gone:
                continue
            except Unavailable as error:
                if error.code != UNREADABLE:
                    raise
                log.warning("%s is left out of the background: %s", reference, error)
        return rows

    def _read_cached(self, reference: RowReference) -> Row:
        with self._lock:
            row = self._cache.get(reference)
        if row is None:
            row = self._read(reference)
            with self._lock:
                self._cache[reference] = row
        return row

    def _read(self, reference: RowReference) -> Row:
        key = reference.object_key
        try:
            row = read_row(self._store, key, reference.row)
        except NotFound:
            raise _reference_expired_error(f"descriptor {key}") from None
        except IndexError:
            raise _reference_expired_error(f"row {reference.row} of {key}") from None
        except ValueError as error:
            raise _unreadable_error(key) from error
        if not key.startswith(QUERIES) and not rows_are_valid(row[np.newaxis]).all():
            raise _unreadable_error(key)
        return row


UNREADABLE = "chunk_unreadable"


def _reference_expired_error(what: str) -> Gone:
    """Error for a query reference whose row, object or generation no longer exists."""
    return Gone("query_expired", f"The {what} no longer exists. Query with the photo again.")


def _unreadable_error(object_key: str) -> Unavailable:
    return Unavailable(
        UNREADABLE,
        f"The descriptor in {object_key} can't be read: the object is missing or damaged. "
        "Query with the photo itself, or restore the object from a backup.",
        object_key=object_key,
    )


MAX_WAIT_SECONDS = 5.0  # for `min_version`; half of the time that the gateway gives a search
FOLLOW_SECONDS = 1.0  # interval of the polls for changes of the catalog
VERSION_POLL_SECONDS = 0.01
LOAD_THREADS = 4  # one may take minutes for a generation that is being built
FILE_CHECK_SECONDS = 5.0  # interval of the checks whether mapped files were changed


class SearchWorker:
    """Holds one snapshot of each generation; `search` is thread-safe.

    A query uses the current snapshot. Only if that is older than `min_version` does it wait, at
    most `max_wait_seconds`, for the thread that loads the newer one. Loading one generation never
    blocks syncing or searching another.
    """

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        *,
        max_wait_seconds: float = MAX_WAIT_SECONDS,
    ) -> None:
        """Create a worker without any snapshot."""
        self.replication_lag = ReplicationLagTracker()
        self._catalog = catalog
        self._max_wait_seconds = max_wait_seconds
        self._store = store
        self._folder = settings.search_cache_folder
        self.query_batcher = QueryBatcher()
        self._memory_budget = MemoryBudget(settings.search_memory_bytes)
        self._query_rows = QueryRowReader(store)
        self._photo_matcher = PhotoMatcher(store)
        self._pose_estimator = PoseEstimator(store, self._photo_matcher)
        self._snapshots: dict[UUID, Snapshot] = {}
        self._lock = threading.Lock()  # of snapshots and loads; never held during I/O
        self._loads: dict[UUID, futures.Future[Snapshot | None]] = {}  # running, of each generation
        self._load_threads = futures.ThreadPoolExecutor(LOAD_THREADS, "search-load")
        self._unreadable = ReadRetries()
        self._files_due: dict[UUID, float] = {}  # next check of each generation's files

    @classmethod
    def from_settings(
        cls, catalog: Catalog, store: ObjectStore, settings: Settings
    ) -> SearchWorker:
        """Create the worker of SEARCH_ENGINE."""
        if settings.search_engine == "milvus":
            try:
                from services.search.milvus.worker import MilvusWorker
            except ImportError as error:
                detail = "SEARCH_ENGINE=milvus needs the extra milvus: pip install pymilvus."
                raise Misconfigured("no_milvus", detail) from error
            return MilvusWorker(catalog, store, settings)
        return cls(catalog, store, settings)

    def run(self, stop: threading.Event) -> None:
        """Sync active generations until `stop` is set."""
        self._sync_until_stopped(stop, (GenerationState.ACTIVE,))

    def run_building(self, stop: threading.Event) -> None:
        """Sync generations that are being built until `stop` is set.

        A thread of its own, because loading may take minutes and must not delay active generations.
        """
        self._sync_until_stopped(stop, (GenerationState.BUILDING,))

    def _sync_until_stopped(
        self, stop: threading.Event, states: Collection[GenerationState]
    ) -> None:
        poll = ChangePoll(self._catalog)
        outage = OutageLog(f"search sync of {' and '.join(states)} generations")
        while not stop.is_set():
            try:
                self.sync(states)
                outage.record_success()
            except SQLAlchemyError as error:  # loaded snapshots go on serving queries
                outage.record_error(error)
            except (OSError, Unavailable) as error:
                log.error("sync failed, loaded snapshots go on serving queries: %s", error)
            poll.wait(stop, FOLLOW_SECONDS)

    def sync(self, states: Collection[GenerationState] = SYNCED_STATES) -> None:
        """Sync every generation of these states to its map's version; drop deleted generations."""
        read_at = time.monotonic()
        # Before the catalog is read: what another thread loads meanwhile has not ended.
        held, stored = self._snapshots.keys(), self._list_stored()
        current = read_generation_versions(self._catalog)
        self.replication_lag.record_catalog_read(current, read_at)
        for generation_id, target in current.items():
            if target.state not in states:
                continue
            snapshot = self._snapshots.get(generation_id)
            if (
                snapshot is None
                or snapshot.version < target.version
                or self._needs_reload(snapshot)
            ):
                self._load(generation_id, target.version)
            self.replication_lag.record_synced(generation_id, read_at)
        ended = held - current.keys()
        for generation_id in ended:
            self._memory_budget.release_generation(generation_id)
        with self._lock:
            self._snapshots = {k: v for k, v in self._snapshots.items() if k not in ended}
            known = {*current, *self._snapshots, *self._loads}
            self._files_due = {k: v for k, v in self._files_due.items() if k in known}
        self._remove_stored(stored, known)
        self._unreadable.forget_others(
            {key for snapshot in self._snapshots.values() for key in snapshot.missing}
        )

    def search(self, request: SearchRequest) -> SearchResponse:
        """Return the most similar rows; see `SearchRequest`."""
        snapshot = self.snapshot(request.generation_id, request.min_version)
        query = self._query_rows.read_query(snapshot, request)
        if request.background:
            background = self._query_rows.read_background(request.background)
            query = subtract_background(query, background)
        return self._find_rows(snapshot, query, request)

    def match(self, request: MatchRequest) -> MatchResponse:
        """Match local features; see `MatchRequest`."""
        return self._photo_matcher.match(request)

    def estimate_pose(self, request: PoseRequest) -> PoseResponse:
        """Compute a pose; see `PoseRequest`."""
        return self._pose_estimator.estimate(request)

    def status(self) -> SearchStatus:
        """Return what is loaded, with sizes and lags."""
        snapshots = self._snapshots
        versions = {key: snapshot.version for key, snapshot in snapshots.items()}
        return SearchStatus(
            rows=sum(snapshot.live_rows for snapshot in snapshots.values()),
            resident_bytes=sum(snapshot.resident_bytes for snapshot in snapshots.values()),
            mapped_bytes=sum(snapshot.mapped_bytes for snapshot in snapshots.values()),
            versions=versions,
            incomplete=tuple(k for k, one in snapshots.items() if one.missing or one.unwritten),
            unwritten=sum(len(snapshot.unwritten) for snapshot in snapshots.values()),
            missing=tuple(key for snapshot in snapshots.values() for key in snapshot.missing),
            disk_full=any(snapshot.disk_full for snapshot in snapshots.values()),
            lags=self.replication_lag.current_lags(versions),
        )

    def state(self) -> dict[str, Any]:
        """Return the versions that are loaded completely, as the process registers them."""
        return {"loaded": {str(key): version for key, version in self.status().loaded.items()}}

    def snapshot(self, generation_id: UUID, min_version: int) -> Snapshot:
        """Return a snapshot at least as new as `min_version`.

        Raises:
            Gone: `query_expired` if the generation no longer exists.
            Unavailable: `search_behind` if the version is not reached within `max_wait_seconds`.
        """
        snapshot = self._snapshots.get(generation_id)
        if snapshot is None or snapshot.version < min_version:
            snapshot = self._load(generation_id, min_version, self._max_wait_seconds)
        if snapshot is None:
            raise _reference_expired_error(f"generation {generation_id}")
        return snapshot

    def _load(
        self, generation_id: UUID, version: int, max_wait_seconds: float = threading.TIMEOUT_MAX
    ) -> Snapshot | None:
        """Wait for a thread to load this version of a generation, or a later one.

        All who wait for a generation wait for the same thread. Returns None if the generation no
        longer exists; raises Unavailable (`search_behind`) when the time is over.
        """
        ends_at = time.monotonic() + max_wait_seconds
        while (seconds := ends_at - time.monotonic()) > 0:
            with self._lock:
                load = self._loads.get(generation_id)
                if load is None:
                    load = self._load_threads.submit(self._load_snapshot, generation_id)
                    self._loads[generation_id] = load
            if futures.wait([load], seconds).done:
                snapshot = load.result()
                if snapshot is None or snapshot.version >= version:
                    return snapshot
                time.sleep(VERSION_POLL_SECONDS)
        raise Unavailable(
            "search_behind",
            f"Search has not caught up with version {version} of the map. Retry in a moment.",
        )

    def _load_snapshot(self, generation_id: UUID) -> Snapshot | None:
        """Load a generation in a thread of its own, and serve the new snapshot."""
        new = None
        try:
            new = self._sync_generation(generation_id, self._snapshots.get(generation_id))
            return new
        finally:
            with self._lock:
                if new is not None:
                    self._snapshots = {**self._snapshots, generation_id: new}
                del self._loads[generation_id]

    # What follows depends on where the rows are; `MilvusWorker` has its own.

    def _sync_generation(self, generation_id: UUID, old: Snapshot | None) -> Snapshot | None:
        """Bring a snapshot up to date; None if the generation no longer exists."""
        return sync_snapshot(
            self._catalog,
            self._store,
            self._folder,
            self._memory_budget,
            generation_id,
            old,
            self._unreadable,
        )

    def _find_rows(self, snapshot: Snapshot, query: Row, request: SearchRequest) -> SearchResponse:
        """Return the rows that are most similar to a query, (dimension,) float32."""
        row_mask = build_row_mask(snapshot.photos, request.photos, request.exclude)
        return execute_query(snapshot, query, row_mask, request.k, self.query_batcher)

    def _list_stored(self) -> list[Any]:
        """List what is stored of any generation outside of this process."""
        return list_generation_folders(self._folder)

    def _remove_stored(self, stored: list[Any], known: Collection[UUID]) -> None:
        """Remove what of this is of generations other than the known ones."""
        remove_stale_folders(stored, known)

    def _needs_reload(self, snapshot: Snapshot) -> bool:
        """Whether a missing chunk is due for a retry, or a mapped file was changed."""
        if self._unreadable.any_due(snapshot.missing):
            return True
        now = time.monotonic()
        if now < self._files_due.get(snapshot.generation_id, 0.0):
            return False
        self._files_due[snapshot.generation_id] = now + FILE_CHECK_SECONDS
        return any(chunk.was_changed() for chunk in snapshot.chunks)
