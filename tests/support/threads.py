"""Calls in threads, together or while something else happens."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def at_once(*calls: Callable[[], T]) -> list[T]:
    """The results of the calls, each of which has a thread of its own."""
    together = threading.Barrier(len(calls))

    def call_together(call: Callable[[], T]) -> T:
        together.wait(60)
        return call()

    with ThreadPoolExecutor(len(calls)) as pool:
        return list(pool.map(call_together, calls))


@contextlib.contextmanager
def meanwhile(call: Callable[[], object], threads: int = 1) -> Iterator[None]:
    """Repeat the call in threads as long as the block runs."""
    done = threading.Event()

    def repeat() -> None:
        while not done.is_set():
            call()

    with ThreadPoolExecutor(threads) as pool:
        repeating = [pool.submit(repeat) for _ in range(threads)]
        try:
            yield
        finally:
            done.set()
        for each in repeating:
            each.result()
