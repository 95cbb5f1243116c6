"""Measures memory bandwidth, and the bytes that a search reads."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from statistics import median
from typing import Any, Self
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from services.search import kernels
from shared.codes.jit import REORDERED_FASTMATH, numba_jit

STREAM_BYTES = 256_000_000  # larger than any CPU cache

Words = NDArray[np.uint64]


@numba_jit(REORDERED_FASTMATH)
def _xor_words(words: Words) -> np.uint64:
    """XOR all words, in four interleaved streams, which read faster than one."""
    quarter = words.shape[0] // 4
    a, b, c = words[:quarter], words[quarter : 2 * quarter], words[2 * quarter : 3 * quarter]
    d = words[3 * quarter :]
    total = np.uint64(0)
    for i in range(quarter):
        total ^= a[i] ^ b[i] ^ c[i] ^ d[i]
    return total


class MemoryBandwidth:
    """Measures memory bandwidth with one thread and with one thread per core; reports the faster.

    A context manager. Samples are taken between other measurements, so that other load on the
    machine affects both.
    """

    def __init__(self, words: Words | None = None) -> None:
        """Measure reads of `words`; by default of an array that is larger than any CPU cache."""
        self._words = np.ones(STREAM_BYTES // 8, np.uint64) if words is None else words.ravel()
        cores = len(os.sched_getaffinity(0))
        self._parts = np.array_split(self._words, cores)
        self._pool = ThreadPoolExecutor(cores, thread_name_prefix="read")
        self._durations: tuple[list[float], list[float]] = ([], [])
        _xor_words(self._words[:8])

    def sample(self) -> None:
        """Read all words once with one thread, and once with one thread per core."""
        started_at = time.perf_counter()
        _xor_words(self._words)
        alone = time.perf_counter()
        list(self._pool.map(_xor_words, self._parts))
        self._durations[0].append(alone - started_at)
        self._durations[1].append(time.perf_counter() - alone)

    @property
    def bytes_per_second(self) -> float:
        """Median bandwidth of the faster one. StatisticsError before the first sample."""
        return self._words.nbytes / min(map(median, self._durations))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()


@dataclass(slots=True)
class ByteCounter:
    """Number of bytes of codes and rows read."""

    size_bytes: int = 0


@contextlib.contextmanager
def count_bytes_read() -> Iterator[ByteCounter]:
    """Count the bytes that searches by codes read inside the block, by wrapping their kernels."""
    count = ByteCounter()

    lock = threading.Lock()
    loops: dict[str, Callable[..., int]] = {
        "hamming_distances": _distance_bytes,
        "add_hamming_distances": lambda _, __, rows, query, *___: 8 * len(query) * len(rows),
        "weighted_bit_sums": lambda _, __, rows, ___, planes, ____: 8 * planes.shape[1] * len(rows),
        "exact_products": lambda _, __, number_bytes, rows, query, *___: (
            int(number_bytes[0]) * len(query) * len(rows)
        ),
    }

    def counted(loop: Callable[..., Any], bytes_of: Callable[..., int]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            with lock:
                count.size_bytes += bytes_of(*arguments)
            return loop(*arguments)

        return call

    callers = [module for name, module in sys.modules.items() if name.startswith("services.search")]
    with contextlib.ExitStack() as patches:
        for name, bytes_of in loops.items():
            loop: Callable[..., Any] = getattr(kernels, name)
            for module in callers:
                if module is not kernels and getattr(module, name, None) is loop:
                    patches.enter_context(patch.object(module, name, counted(loop, bytes_of)))
        yield count


def _distance_bytes(
    _blocks: Any, _first: Any, mask: NDArray[np.bool_], query: Words, begin: int, end: int, *_: Any
) -> int:
    rows = np.count_nonzero(mask[..., begin:end].reshape(-1, end - begin).any(axis=0))
    return 8 * int(query.shape[-1]) * int(rows)
