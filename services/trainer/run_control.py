"""What a run tells whoever watches it; the command line shows it with bars.

Ctrl-C and SIGTERM: the run is kept after the step at work, then it ends.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Protocol


class Display(Protocol):
    def info(self, text: str) -> None:
        """A line for the record."""

    def warn(self, text: str) -> None:
        """A line that asks for attention."""

    def progress(self, what: str, done: int, most: int, note: str = "") -> None:
        """How far `what` is; it begins when first heard of and ends at `most`."""


class NullDisplay:
    """Shows nothing; what was said stays, for whoever asks."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def info(self, text: str) -> None:
        self.said.append(text)

    def warn(self, text: str) -> None:
        self.said.append(text)

    def progress(self, what: str, done: int, most: int, note: str = "") -> None:
        return


SIGNALS = (signal.SIGINT, signal.SIGTERM)


class RunStopped(Exception):
    """Somebody asked for the end, and the run is on disk as it was after the last step."""


class StopRequest:
    """Whether the end was asked for. The second time it is not waited for."""

    def __init__(self) -> None:
        self.asked = False
        self._is_listening = False

    @contextmanager
    def handle_signals(self) -> Iterator[StopRequest]:
        """Take the signals for as long as the block lasts; only in the main thread."""
        before = {number: signal.getsignal(number) for number in SIGNALS}
        self._is_listening = True
        self.install_handlers()
        try:
            yield self
        finally:
            self._is_listening = False
            for number, handler in before.items():
                signal.signal(number, handler)

    def install_handlers(self) -> None:
        """Take them back from Lightning, which puts a handler of its own before that of SIGTERM and
        would end the run with nothing kept."""
        if self._is_listening:
            for number in SIGNALS:
                signal.signal(number, self._take)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def check(self) -> None:
        """RunStopped when the end was asked for. Called where what is on disk is complete."""
        if self.asked:
            raise RunStopped
