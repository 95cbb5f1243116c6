"""Cache of the rankings of stored photos, which each estimate needs of its best photo.

Queries that show the same places have the same best photos; without the cache, each of them would
cost a second search of the whole map.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable

from cachetools import LRUCache

from shared.evaluation.places.evidence import RankedPhoto

CACHED_RANKINGS = 1000  # of about 50 photos: 20 MB

Neighbours = tuple[RankedPhoto, ...]
"""The photos of the map that are most similar to one of them, best first."""


class NeighbourCache:
    """Thread-safe LRU cache of rankings, by a key that changes when the map does."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cache: LRUCache[Hashable, Neighbours] = LRUCache(CACHED_RANKINGS)

    def get_or_search(
        self, key: Hashable, search: Callable[[], tuple[Neighbours, bool]]
    ) -> Neighbours:
        """Return the cached ranking of a key, which holds everything that it depends on.

        If there is none, `search` returns it, and whether it is complete; others are not cached.
        """
        with self._lock:
            cached = self._cache.get(key)
        if cached is not None:
            return cached
        found, is_complete = search()
        if is_complete:
            with self._lock:
                self._cache[key] = found
        return found
