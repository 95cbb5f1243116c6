"""Hints: "there may be work". Losing one costs a second, never a job."""

from __future__ import annotations

import threading
from typing import Protocol


class Hints(Protocol):
    """The port over which whoever queued a job wakes a worker."""

    def send(self) -> None:
        """Wake a worker. Never raises: the job is already committed and will be found anyway."""

    def wait(self, seconds: float) -> bool:
        """Sleep until a hint comes or the time is up; True when a hint came."""


class InProcessHints:
    """Hints inside one process, for the embedded mode: at most one is outstanding."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def send(self) -> None:
        self._event.set()

    def wait(self, seconds: float) -> bool:
        came = self._event.wait(seconds)
        self._event.clear()
        return came
