"""One piece of work over many rows, on several processors."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

MIN_PART_BYTES = 4_000_000  # less is done before another thread has woken up


def parallel_for(run_range: Callable[[int, int], None], rows: int, bytes_each: int) -> None:
    """Call `work(begin, end)` for parts that make up 0 to `rows`, of so many bytes each row.

    One part is worked on here. `run_range` has to let go of the interpreter's lock to gain anything.
    """
    parts = max(1, min(_cpu_count(), rows * bytes_each // MIN_PART_BYTES))
    ends = [rows * (part + 1) // parts for part in range(parts)]
    others = [_thread_pool().submit(run_range, *span) for span in pairwise(ends)]
    run_range(0, ends[0])
    for other in others:
        other.result()


@cache
def _cpu_count() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _thread_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _cpu_count() - 1), "search-part")
