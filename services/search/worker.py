"""Search worker: `SearchBackend` in process, on snapshots that are swapped atomically.

`SearchWorker` keeps a snapshot of each generation in sync with the catalog and runs queries on the
current one. `QueryRowReader` reads the row that a query refers to, which may lie in a chunk
that has been merged since, or under `queries/`. It caches stored rows:
the gateway asks for more hits of the same query, and evaluations use the same photos again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Collection, Sequence
from concurrent import futures
from uuid import UUID

import numpy as np
from cachetools import LRUCache
from sqlalchemy.exc import SQLAlchemyError

from services.search.catalog_sync import (
    SYNCED_STATES,
    ReplicationLagTracker,
    read_generation_versions,
)
from services.search.memory_index import MemoryIndex
from services.search.photo_matcher import PhotoMatcher
from services.search.pose_estimator import PoseEstimator
from services.search.query_batcher import QueryBatcher
from services.search.row_index import IndexSnapshot, RowIndex
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import IDLE_SECONDS, Catalog, ChangePoll
from shared.catalog.generations import GenerationState
from shared.config.settings import Settings
from shared.errors import Gone, NotFound, Unavailable
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

    def read_query(self, snapshot: IndexSnapshot, request: SearchRequest) -> Row:
        """Return the (dimension,) row that a request refers to.

        Raises:
            Gone: `query_expired` if the row no longer exists.
            Unavailable: `chunk_unreadable` if the row's object is damaged.
        """
        if request.object_key in snapshot.unreadable and not snapshot.disk_full:
            raise _unreadable_error(request.object_key)
        try:
            row = snapshot.read_row(request.object_key, request.row)
        except IndexError:
            raise _reference_expired_error(f"row {request.row} of {request.object_key}") from None
        if row is not None:
            return row
        reference = RowReference(object_key=request.object_key, row=request.row)
        if request.object_key.startswith(QUERIES):  # expires with its object
            return self._read(reference)
        return self._read_cached(reference)

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
        self.query_batcher = QueryBatcher()
        self._unreadable = ReadRetries()
        self._index: RowIndex
        if settings.search_engine == "milvus":
            from services.search.milvus.index import MilvusIndex  # needs the extra milvus

            self._index = MilvusIndex(catalog, store, settings, self._unreadable)
        else:
            self._index = MemoryIndex(
                catalog, store, settings, self._unreadable, self.query_batcher
            )
        self._query_rows = QueryRowReader(store)
        self._photo_matcher = PhotoMatcher(store)
        self._pose_estimator = PoseEstimator(store, self._photo_matcher)
        self._snapshots: dict[UUID, IndexSnapshot] = {}
        self._lock = threading.Lock()  # of snapshots and loads; never held during I/O
        self._loads: dict[UUID, futures.Future[IndexSnapshot | None]] = {}  # running
        self._load_threads = futures.ThreadPoolExecutor(LOAD_THREADS, "search-load")

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
        failure = ""
        while not stop.is_set():
            try:
                self.sync(states)
                outage.record_success()
                failure = ""
            except SQLAlchemyError as error:  # loaded snapshots go on serving queries
                outage.record_error(error)
            except (OSError, Unavailable) as error:
                if failure != str(error):
                    log.error("sync failed, loaded snapshots go on serving queries: %s", error)
                failure = str(error)
            idle_seconds = FOLLOW_SECONDS if self._index.changes_alone else IDLE_SECONDS
            poll.wait(stop, FOLLOW_SECONDS, idle_seconds)

    def sync(self, states: Collection[GenerationState] = SYNCED_STATES) -> None:
        """Sync every generation of these states to its map's version; drop deleted generations."""
        read_at = time.monotonic()
        # Before the catalog is read: what another thread loads meanwhile has not ended.
        searched, held = self._snapshots.keys(), self._index.list_held()
        current = read_generation_versions(self._catalog)
        self.replication_lag.record_catalog_read(current, read_at)
        for generation_id, target in current.items():
            if target.state not in states:
                continue
            snapshot = self._snapshots.get(generation_id)
            if (
                snapshot is None
                or snapshot.version < target.version
                or self._index.needs_sync(snapshot)
            ):
                self._load(generation_id, target.version)
            self.replication_lag.record_synced(generation_id, read_at)
        ended = searched - current.keys()
        with self._lock:
            self._snapshots = {k: v for k, v in self._snapshots.items() if k not in ended}
            known = {*current, *self._snapshots, *self._loads}
        self._index.remove_others(held, known)
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
        return self._index.search(snapshot, query, request)

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
        parts = [part for snapshot in snapshots.values() for part in snapshot.parts]
        return SearchStatus(
            rows=sum(snapshot.live_rows for snapshot in snapshots.values()),
            resident_bytes=sum(part.size_bytes for part in parts if part.resident),
            mapped_bytes=sum(part.size_bytes for part in parts if not part.resident),
            held={key: snapshot.held for key, snapshot in snapshots.items()},
            versions=versions,
            incomplete=tuple(key for key, snapshot in snapshots.items() if snapshot.missing),
            missing=tuple(key for snapshot in snapshots.values() for key in snapshot.missing),
            unreadable=tuple(key for each in snapshots.values() for key in each.unreadable),
            disk_full=any(snapshot.disk_full for snapshot in snapshots.values()),
            lags=self.replication_lag.current_lags(versions),
            recalls=dict(self._index.recalls),
        )

    def snapshot(self, generation_id: UUID, min_version: int) -> IndexSnapshot:
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
    ) -> IndexSnapshot | None:
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

    def _load_snapshot(self, generation_id: UUID) -> IndexSnapshot | None:
        """Load a generation in a thread of its own, and serve the new snapshot."""
        new = None
        try:
            new = self._index.sync(generation_id, self._snapshots.get(generation_id))
            return new
        finally:
            with self._lock:
                if new is not None:
                    self._snapshots = {**self._snapshots, generation_id: new}
                del self._loads[generation_id]
