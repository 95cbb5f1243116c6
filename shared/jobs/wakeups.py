"""Wakeups: messages on which workers look for jobs in the job table.

A lost wakeup delays a job by seconds and never loses it; a duplicate is harmless. Queries have a
queue of their own, so that a worker can receive their wakeups first. Which jobs a worker runs is
decided by the job table alone.
"""

from __future__ import annotations

import threading
from enum import StrEnum
from typing import Protocol

from shared.catalog.jobs import Priority


class WakeupQueue(StrEnum):
    QUERY = "placewise.query"  # a client waits for the result
    BULK = "placewise.bulk"


def queue_for_priority(priority: int) -> WakeupQueue:
    """Return the queue for wakeups of jobs with this priority."""
    return WakeupQueue.QUERY if priority >= Priority.QUERY else WakeupQueue.BULK


class Wakeups(Protocol):
    """Interface for waking a worker after a job was queued."""

    def send(self, queue: WakeupQueue = WakeupQueue.BULK) -> None:
        """Wake a worker. Never raises and never blocks: the job is already committed, and workers
        find it without a wakeup, too."""


class InProcessWakeups:
    """Wakeups inside one process, for the embedded mode: at most one is outstanding."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def send(self, queue: WakeupQueue = WakeupQueue.BULK) -> None:
        self._event.set()

    def wait(self, seconds: float) -> bool:
        """Block until a wakeup arrives or the timeout expires; True when one arrived."""
        arrived = self._event.wait(seconds)
        self._event.clear()
        return arrived
