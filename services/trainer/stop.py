"""Ctrl-C and SIGTERM: the run is kept after the step at work, then it ends."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class RunStopped(Exception):
    """Somebody asked for the end, and the run is on disk as it was after the last step."""


class StopRequest:
    """Whether the end was asked for. The second time it is not waited for."""

    def __init__(self) -> None:
        self.asked = False

    @contextmanager
    def listening(self) -> Iterator[StopRequest]:
        """Take the signals for as long as the block lasts; only in the main thread."""
        before = {number: signal.signal(number, self._take) for number in SIGNALS}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def check(self) -> None:
        """RunStopped when the end was asked for. Called where what is on disk is complete."""
        if self.asked:
            raise RunStopped
