"""How many photos may be stored through one key. Deleted photos make room again."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from uuid import UUID

from shared.catalog.keys import count_photos_of_key
from shared.catalog.session import Catalog
from shared.errors import TooManyRequests

RECOUNT_SECONDS = 10.0
FULL_RECOUNT_SECONDS = 1.0  # once the limit is reached
QUOTA_RETRY_SECONDS = 3600


@dataclass(slots=True)
class KeyPhotos:
    """The photos of one key as this process knows them, under `lock`."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    counted_at: float = -RECOUNT_SECONDS
    counted: int = 0
    """In the catalog, at `counted_at` (monotonic seconds)."""
    stored: int = 0
    """By this process since then, at most: bytes that were there already are no further photo."""


class PhotoQuota:
    """Counts the photos of each key. Thread-safe.

    One process never passes a limit: it stores the photos of a limited key one after the other.
    What other processes store is known after LOOK_SECONDS at the latest.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._keys: dict[UUID, KeyPhotos] = {}

    def check(self, key_id: UUID, most: int) -> None:
        """Refuse early, before a photo is received. TooManyRequests (`photo_quota_reached`)."""
        photos = self._keys.setdefault(key_id, KeyPhotos())
        with photos.lock:
            self._check(photos, key_id, most)

    @contextlib.contextmanager
    def place(self, key_id: UUID, most: int) -> Iterator[None]:
        """Room for one photo, which the block stores. TooManyRequests (`photo_quota_reached`)."""
        photos = self._keys.setdefault(key_id, KeyPhotos())
        with photos.lock:
            self._check(photos, key_id, most)
            photos.stored += 1  # also where the block raises: its transaction may be committed
            yield

    def _check(self, photos: KeyPhotos, key_id: UUID, most: int) -> None:
        age_seconds = time.monotonic() - photos.counted_at
        seems_full = photos.counted < most <= photos.counted + photos.stored
        if seems_full or age_seconds >= (
            RECOUNT_SECONDS if photos.counted < most else FULL_RECOUNT_SECONDS
        ):
            with self._catalog.read() as session:
                photos.counted = count_photos_of_key(session, key_id, most)
            photos.counted_at, photos.stored = time.monotonic(), 0
        if photos.counted >= most:
            raise TooManyRequests(
                "photo_quota_reached",
                f"{most} photos are stored through this key, and no more may be. Delete some, or "
                "ask an admin for a key with a higher limit.",
                retry_after_seconds=QUOTA_RETRY_SECONDS,
                limit=most,
            )
