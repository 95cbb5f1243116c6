"""One piece of work over many rows, on several processors."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

PART_BYTES = 4_000_000  # less is done before another thread has woken up


def in_parts(work: Callable[[int, int], None], rows: int, bytes_each: int) -> None:
    """Call `work(begin, end)` for parts that make up 0 to `rows`, of so many bytes each row.

    One part is worked on here. `work` has to let go of the interpreter's lock to gain anything.
    """
    parts = max(1, min(_processors(), rows * bytes_each // PART_BYTES))
    ends = [rows * (part + 1) // parts for part in range(parts)]
    others = [_threads().submit(work, *span) for span in pairwise(ends)]
    work(0, ends[0])
    for other in others:
        other.result()


@cache
def _processors() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _processors() - 1), "search-part")
