"""The search port in one process: snapshots swapped atomically, queries on whichever is current."""

from __future__ import annotations

import logging
import threading
import time
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.exc import SQLAlchemyError

from services.search.follow import advance, versions
from services.search.scan import top_k
from services.search.snapshot import Snapshot
from shared.catalog.session import Catalog
from shared.chunks import decode_rows
from shared.errors import Gone, NotFound, Unavailable
from shared.objects import ObjectStore
from shared.search_protocol import Hit, SearchRequest, SearchResponse, SearchStatus
from shared.settings import Settings

log = logging.getLogger(__name__)

WAIT_STEP_SECONDS = 0.01


class SearchWorker:
    """Holds one snapshot per generation. `run` follows the catalog; `search` is thread-safe.

    A query never waits for a lock that a loading thread holds: it takes the current snapshot, and
    only when that is older than `min_version` it catches up (or waits for whoever does).
    """

    def __init__(self, catalog: Catalog, store: ObjectStore, settings: Settings) -> None:
        self._catalog = catalog
        self._store = store
        self._settings = settings
        self._snapshots: dict[UUID, Snapshot] = {}
        self._loading = threading.Lock()

    def run(self, stop: threading.Event) -> None:
        """Follow every map until `stop` is set."""
        while not stop.is_set():
            try:
                self.follow()
            except (SQLAlchemyError, OSError):
                log.exception("search can't follow the catalog; serving what is loaded")
            stop.wait(self._settings.search_follow_seconds)

    def follow(self) -> None:
        """Bring every followed generation to its map's version; forget those that are gone."""
        wanted = versions(self._catalog)
        for generation_id, (_, version) in wanted.items():
            snapshot = self._snapshots.get(generation_id)
            if snapshot is None or snapshot.version < version or snapshot.missing:
                self._advance(generation_id, version)
        with self._loading:
            kept = {key: value for key, value in self._snapshots.items() if key in wanted}
            self._snapshots = kept

    def search(self, request: SearchRequest) -> SearchResponse:
        snapshot = self._snapshot(request.generation_id, request.min_version)
        query = self._query(snapshot, request)
        hits, scanned, reranked = top_k(
            snapshot.chunks,
            query,
            request.k,
            min_score=request.min_score,
            wanted=request.photos,
            exclude=frozenset(request.exclude),
        )
        return SearchResponse(
            hits=tuple(Hit(photo_id=photo_id, score=score) for photo_id, score in hits),
            certificate="exhaustive",
            rows_scanned=scanned,
            rows_reranked=reranked,
            snapshot_version=snapshot.version,
            missing=snapshot.missing,
        )

    def status(self) -> SearchStatus:
        snapshots = self._snapshots
        return SearchStatus(
            rows=sum(snapshot.live_rows for snapshot in snapshots.values()),
            resident_bytes=sum(snapshot.resident_bytes for snapshot in snapshots.values()),
            versions={key: snapshot.version for key, snapshot in snapshots.items()},
            missing=tuple(key for snapshot in snapshots.values() for key in snapshot.missing),
        )

    def _snapshot(self, generation_id: UUID, min_version: int) -> Snapshot:
        """A snapshot at least as new as `min_version`; Unavailable when that takes too long."""
        deadline = time.monotonic() + self._settings.search_wait_seconds
        while True:
            snapshot = self._snapshots.get(generation_id)
            if snapshot is not None and snapshot.version >= min_version:
                return snapshot
            snapshot = self._advance(generation_id, min_version)
            if snapshot is None:
                raise _expired(f"generation {generation_id}")
            if snapshot.version >= min_version:
                return snapshot
            if time.monotonic() > deadline:
                raise Unavailable(
                    "search_behind",
                    f"Search has not caught up with version {min_version} of the map. "
                    "Ask again in a moment.",
                )
            time.sleep(WAIT_STEP_SECONDS)

    def _advance(self, generation_id: UUID, version: int) -> Snapshot | None:
        with self._loading:
            old = self._snapshots.get(generation_id)
            if old is not None and old.version >= version and not old.missing:
                return old  # another thread loaded it while this one waited
            new = advance(self._catalog, self._store, generation_id, old)
            if new is not None:
                self._snapshots = {**self._snapshots, generation_id: new}
            return new

    def _query(self, snapshot: Snapshot, request: SearchRequest) -> NDArray[np.float32]:
        """The descriptor that the request refers to."""
        loaded = snapshot.by_key.get(request.object_key)
        if request.object_key in snapshot.missing:
            raise _unreadable(request.object_key)
        try:
            rows = loaded.rows if loaded else decode_rows(self._store.get(request.object_key))
        except NotFound:
            raise _expired(f"descriptor {request.object_key}") from None
        except ValueError as error:
            raise _unreadable(request.object_key) from error
        if request.row >= len(rows):
            raise _expired(f"row {request.row} of {request.object_key}")
        row: NDArray[np.float32] = rows[request.row]
        return row


def _expired(what: str) -> Gone:
    return Gone("query_expired", f"The {what} is no longer kept. Ask with the photo again.")


def _unreadable(object_key: str) -> Unavailable:
    return Unavailable(
        "chunk_unreadable",
        f"The descriptor in {object_key} can't be read: the object is missing or damaged. "
        "Ask with the photo itself, or restore the object from a backup.",
        object_key=object_key,
    )
