"""How many photos may be stored through one key. Deleted photos make room again."""

from __future__ import annotations

import time
from collections import Counter
from uuid import UUID

from shared.catalog.keys import count_photos_of
from shared.catalog.session import Catalog
from shared.errors import TooManyRequests

LOOK_SECONDS = 10.0
FULL_LOOK_SECONDS = 1.0  # once the limit is reached
RETRY_SECONDS = 3600
KEYS_REMEMBERED = 1000


class PhotoQuota:
    """Counts by looking, and what was taken since: a limit may be passed by what is being received
    at that moment, and by what other processes take within LOOK_SECONDS. Thread-safe."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._seen: dict[UUID, tuple[float, int]] = {}
        self._taken: Counter[UUID] = Counter()

    def take(self, key_id: UUID, most: int) -> None:
        """Room for one more photo. TooManyRequests (`photo_quota_reached`)."""
        looked_at, stored = self._seen.get(key_id, (-LOOK_SECONDS, 0))
        age_seconds = time.monotonic() - looked_at
        # What was taken may have been refused since, or was there already: full is who looks full.
        seems_full = stored < most <= stored + self._taken[key_id]
        if seems_full or age_seconds >= (LOOK_SECONDS if stored < most else FULL_LOOK_SECONDS):
            stored = self._look(key_id, most)
        if stored >= most:
            raise TooManyRequests(
                "photo_quota_reached",
                f"{most} photos are stored through this key, and no more may be. Delete some, or "
                "ask an admin for a key with a higher limit.",
                retry_after_seconds=RETRY_SECONDS,
                limit=most,
            )
        self._taken[key_id] += 1

    def _look(self, key_id: UUID, most: int) -> int:
        if len(self._seen) >= KEYS_REMEMBERED:
            self._seen.clear()
        self._taken[key_id] = 0
        with self._catalog.read() as session:
            stored = count_photos_of(session, key_id, most)
        self._seen[key_id] = (time.monotonic(), stored)
        return stored
