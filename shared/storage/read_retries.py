"""Retries with exponential backoff for objects that can't be read."""

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
MAX_MISSING_RETRY_SECONDS = 5.0  # a request for a missing object is cheap
MAX_DAMAGED_RETRY_SECONDS = 60.0  # a damaged object is read completely each time


@dataclass(frozen=True, slots=True)
class _Retry:
    due_at: float
    """Monotonic seconds."""
    delay_seconds: float


class ReadRetries:
    """The schedule of the next read of each unreadable object, by name. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._retries: dict[str, _Retry] = {}

    def is_due(self, name: str) -> bool:
        """Return whether the object may be read now: it never failed, or its delay is over."""
        with self._lock:
            retry = self._retries.get(name)
            return retry is None or time.monotonic() >= retry.due_at

    def any_due(self, names: Iterable[str]) -> bool:
        return any(self.is_due(name) for name in names)

    def failed(self, name: str, error: Exception) -> None:
        """Schedule the next read. The first failure is logged as an error, later ones as debug."""
        damaged = isinstance(error, ValueError) or (
            isinstance(error, PlacewiseError) and error.code == CORRUPT
        )
        max_delay = MAX_DAMAGED_RETRY_SECONDS if damaged else MAX_MISSING_RETRY_SECONDS
        with self._lock:
            retry = self._retries.get(name)
            delay = min(retry.delay_seconds * 2 if retry else FIRST_RETRY_SECONDS, max_delay)
            self._retries[name] = _Retry(time.monotonic() + delay, delay)
        log.log(
            logging.DEBUG if retry else logging.ERROR,
            "%s can't be read and will be retried until it can: %s",
            name,
            error,
        )

    def succeeded(self, name: str) -> None:
        with self._lock:
            retry = self._retries.pop(name, None)
        if retry is not None:
            log.warning("%s can be read again", name)

    def forget_others(self, names: Collection[str]) -> None:
        """Drop the schedules of all other names."""
        with self._lock:
            self._retries = {k: v for k, v in self._retries.items() if k in names}
