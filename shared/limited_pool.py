"""Pools of processes with a memory limit, for files of others."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import resource
from collections.abc import Callable

from pebble import ProcessPool


def limited_pool(processes: int, memory_bytes: int, prepare: Callable[[], object]) -> ProcessPool:
    """Return a pool; its processes call `prepare`, and can't have more data than `memory_bytes`."""
    return ProcessPool(
        max_workers=processes,
        # Forking is not safe in a process with torch's threads and locks.
        context=multiprocessing.get_context("spawn"),
        initializer=_start,
        initargs=[memory_bytes, pickle.dumps(prepare)],
    )


def _start(memory_bytes: int, prepare: bytes) -> None:
    # Before `prepare` imports NumPy: its threads, one for each processor, would take 40 MB each.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    pickle.loads(prepare)()  # noqa: S301 -- from the parent process
