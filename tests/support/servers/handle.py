"""What tests may do to a server of their own."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol


class Handle(Protocol):
    """A server's process or container. It keeps its port and its data through all of this."""

    def start(self) -> None:
        """Start it (again) and wait until it answers."""

    def stop(self) -> None:
        """In good order; returns when it has ended."""

    def kill(self) -> None:
        """SIGKILL; returns when it has ended."""

    def pause(self) -> None:
        """SIGSTOP: connections stand, nothing is answered."""

    def resume(self) -> None: ...

    def cpu_seconds(self) -> float:
        """User and system time so far, of all its processes."""

    def close(self) -> None:
        """End it for good, and remove its data."""


def wait_until(
    answers: Callable[[], bool], seconds: float, failed: Callable[[], str | None], name: str
) -> None:
    """AssertionError when it does not answer in time, or `failed` says why it never will."""
    deadline = time.monotonic() + seconds
    while not answers():
        reason = failed()
        if reason is not None:
            raise AssertionError(f"{name} ended: {reason}")
        if time.monotonic() > deadline:
            raise AssertionError(f"{name} did not answer in {seconds:g} s")
        time.sleep(0.02)
