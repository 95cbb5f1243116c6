"""Pools of processes with a memory limit, for files of others."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import resource
from collections.abc import Callable
from typing import Any

from pebble import ProcessPool


def limited_pool(
    processes: int, memory_bytes: int, prepare: Callable[..., object], *args: Any
) -> ProcessPool:
    """Return a pool; its processes call `prepare(*args)`, and have at most `memory_bytes` of data.

    The arguments are copied to each process once: one may be a file of hundreds of megabytes.
    """
    return ProcessPool(
        max_workers=processes,
        # Forking is not safe in a process with torch's threads and locks.
        context=multiprocessing.get_context("spawn"),
        initializer=_start,
        initargs=[memory_bytes, pickle.dumps(prepare), *args],
    )


def _start(memory_bytes: int, prepare: bytes, *args: Any) -> None:
    # Before NumPy is imported: its threads, one for each processor, would take 40 MB each.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    pickle.loads(prepare)(*args)  # noqa: S301 -- from the parent process
