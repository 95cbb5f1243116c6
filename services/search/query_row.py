"""The descriptor that a query refers to: in memory, or one row read from the object store.

The row may lie in a chunk of another shard, in a chunk that was merged into another since, or
under `queries/`. The few rows that were read last are kept: the gateway asks for more hits of one
query, and evaluations come back to the same photos.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np

from services.search.snapshot import Snapshot
from shared.chunks import Row, read_row, rows_are_valid
from shared.errors import Gone, NotFound, Unavailable
from shared.objects import ObjectStore
from shared.objects.keys import QUERIES
from shared.search_protocol import SearchRequest

CACHED_ROWS = 64  # 25 MB at 98,304 dimensions


class QueryRowReader:
    """Reads query rows; thread-safe."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._cache: OrderedDict[tuple[str, int], Row] = OrderedDict()

    def read_query(self, snapshot: Snapshot, request: SearchRequest) -> Row:
        """The (dimension,) row. Gone (`query_expired_error`) when it is no longer kept, Unavailable
        (`chunk_unreadable`) when it is damaged."""
        loaded = snapshot.by_key.get(request.object_key)
        if request.object_key in snapshot.missing:
            raise _unreadable_error(request.object_key)
        if loaded is None:
            return self._read_cached(request.object_key, request.row)
        if request.row >= len(loaded.rows):
            raise query_expired_error(f"row {request.row} of {request.object_key}")
        row: Row = loaded.rows[request.row]
        return row

    def _read_cached(self, object_key: str, row: int) -> Row:
        at = (object_key, row)
        with self._lock:
            kept = self._cache.get(at)
            if kept is not None:
                self._cache.move_to_end(at)
                return kept
        try:
            found = read_row(self._store, object_key, row)
        except NotFound:
            raise query_expired_error(f"descriptor {object_key}") from None
        except IndexError:
            raise query_expired_error(f"row {row} of {object_key}") from None
        except ValueError as error:
            raise _unreadable_error(object_key) from error
        if object_key.startswith(QUERIES):
            return found  # not kept: it goes with its object, after QUERY_TTL_SECONDS
        if not rows_are_valid(found[np.newaxis]).all():
            raise _unreadable_error(object_key)
        with self._lock:
            self._cache[at] = found
            while len(self._cache) > CACHED_ROWS:
                self._cache.popitem(last=False)
        return found


def query_expired_error(what: str) -> Gone:
    """What a query needs is no longer kept."""
    return Gone("query_expired", f"The {what} is no longer kept. Ask with the photo again.")


def _unreadable_error(object_key: str) -> Unavailable:
    return Unavailable(
        "chunk_unreadable",
        f"The descriptor in {object_key} can't be read: the object is missing or damaged. "
        "Ask with the photo itself, or restore the object from a backup.",
        object_key=object_key,
    )
