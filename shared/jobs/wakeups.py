"""Hints: "there may be work". Losing one costs seconds, never a job; two of one are harmless.

There are two lanes, so that whoever serves queries first sees them first. What a woken worker does
is decided by the job table alone.
"""

from __future__ import annotations

import threading
from enum import StrEnum
from typing import Protocol

from shared.catalog.jobs import Priority


class WakeupQueue(StrEnum):
    QUERY = "placewise.query"  # someone waits for the answer
    BULK = "placewise.bulk"


def queue_for_priority(priority: int) -> WakeupQueue:
    """The lane that a job of this priority is hinted on."""
    return WakeupQueue.QUERY if priority >= Priority.QUERY else WakeupQueue.BULK


class Wakeups(Protocol):
    """The port over which whoever queued a job wakes a worker."""

    def send(self, lane: WakeupQueue = WakeupQueue.BULK) -> None:
        """Wake a worker. Never raises and never waits: the job is already committed and will be
        found anyway."""


class InProcessWakeups:
    """Hints inside one process, for the embedded mode: at most one is outstanding."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def send(self, lane: WakeupQueue = WakeupQueue.BULK) -> None:
        self._event.set()

    def wait(self, seconds: float) -> bool:
        """Sleep until a hint comes or the time is up; True when a hint came."""
        came = self._event.wait(seconds)
        self._event.clear()
        return came
