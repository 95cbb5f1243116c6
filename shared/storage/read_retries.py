"""Retries with exponential backoff for objects that cannot be read."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from shared.errors import PlacewiseError
from shared.storage.chunks import CORRUPT

log = logging.getLogger(__name__)

FIRST_RETRY_SECONDS = 1.0  # doubled with each failure
MAX_MISSING_RETRY_SECONDS = 5.0  # asking for an object that is not there costs little
MAX_DAMAGED_RETRY_SECONDS = 60.0  # a damaged one is read from its first byte to its last


@dataclass(frozen=True, slots=True)
class _Retry:
    at: float
    """Monotonic seconds."""
    pause_seconds: float


class ReadRetries:
    """What could not be read, by name, and when each is read again. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._retries: dict[str, _Retry] = {}

    def is_due(self, name: str) -> bool:
        """Whether it may be read now: it never failed, or its pause is over."""
        with self._lock:
            retry = self._retries.get(name)
            return retry is None or time.monotonic() >= retry.at

    def any_due(self, names: Iterable[str]) -> bool:
        return any(self.is_due(name) for name in names)

    def failed(self, name: str, error: Exception) -> None:
        """Schedule the next read. The first failure is logged; later ones at debug level."""
        damaged = isinstance(error, ValueError) or (
            isinstance(error, PlacewiseError) and error.code == CORRUPT
        )
        longest = MAX_DAMAGED_RETRY_SECONDS if damaged else MAX_MISSING_RETRY_SECONDS
        with self._lock:
            retry = self._retries.get(name)
            pause = min(retry.pause_seconds * 2 if retry else FIRST_RETRY_SECONDS, longest)
            self._retries[name] = _Retry(time.monotonic() + pause, pause)
        log.log(
            logging.DEBUG if retry else logging.ERROR,
            "%s can't be read, and is tried again until it can: %s",
            name,
            error,
        )

    def succeeded(self, name: str) -> None:
        with self._lock:
            known = self._retries.pop(name, None)
        if known is not None:
            log.warning("%s can be read again", name)

    def forget_others(self, names: Collection[str]) -> None:
        """Forget everything but these names."""
        with self._lock:
            self._retries = {k: v for k, v in self._retries.items() if k in names}
