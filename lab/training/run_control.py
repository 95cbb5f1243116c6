"""Run control: the display interface of a training run, and graceful stop on SIGINT and SIGTERM.

The first signal saves the run after the current step and stops it; the second one interrupts it
at once.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Protocol


class Display(Protocol):
    """Interface through which a run reports messages and progress to the user."""

    def info(self, text: str) -> None:
        """Show a message."""

    def warn(self, text: str) -> None:
        """Show a warning."""

    def progress(self, what: str, done: int, total: int, note: str = "") -> None:
        """Report the progress of a task; its first call starts it, `done >= total` ends it."""


class NullDisplay:
    """Display without output; it collects messages and warnings in `messages`."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    def info(self, text: str) -> None:
        self.messages.append(text)

    def warn(self, text: str) -> None:
        self.messages.append(text)

    def progress(self, what: str, done: int, total: int, note: str = "") -> None:
        return


SIGNALS = (signal.SIGINT, signal.SIGTERM)


class RunStopped(Exception):
    """Raised after a requested stop; the run is saved as it was after its last step."""


class StopRequest:
    """Flag that a signal sets to request a graceful stop; a second signal interrupts at once."""

    def __init__(self) -> None:
        self.is_requested = False

    @contextmanager
    def handle_signals(self) -> Iterator[StopRequest]:
        """Handle SIGINT and SIGTERM inside the block. Only for the main thread."""
        before = {number: signal.signal(number, self._handle_signal) for number in SIGNALS}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _handle_signal(self, number: int, frame: FrameType | None) -> None:
        if self.is_requested:
            raise KeyboardInterrupt
        self.is_requested = True

    def check(self) -> None:
        """Raise RunStopped if a stop was requested. Call it only when the saved run is complete."""
        if self.is_requested:
            raise RunStopped
