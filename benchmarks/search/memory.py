"""How fast this machine reads memory, what a search reads of it, and how much a process holds."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Self
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from services.search import cascade
from shared.codes.compiled import IN_LANES, compiled

STREAM_BYTES = 256_000_000  # beyond every cache

Words = NDArray[np.uint64]


@compiled(IN_LANES)
def _read(words: Words) -> np.uint64:
    """Something that depends on every word; four streams at once, which is faster than one."""
    quarter = words.shape[0] // 4
    a, b, c = words[:quarter], words[quarter : 2 * quarter], words[2 * quarter : 3 * quarter]
    d = words[3 * quarter :]
    found = np.uint64(0)
    for i in range(quarter):
        found ^= a[i] ^ b[i] ^ c[i] ^ d[i]
    return found


class ReadSpeed:
    """How fast memory is read: by one thread, and by one on each core; the faster is the floor.

    A context manager. Samples are taken between other measurements, so that what disturbs one
    disturbs the other.
    """

    def __init__(self, words: Words | None = None) -> None:
        """What is read: these words, or some that lie in no cache."""
        self._words = np.ones(STREAM_BYTES // 8, np.uint64) if words is None else words.ravel()
        cores = len(os.sched_getaffinity(0))
        self._parts = np.array_split(self._words, cores)
        self._pool = ThreadPoolExecutor(cores, thread_name_prefix="read")
        self._took: tuple[list[float], list[float]] = ([], [])
        _read(self._words[:8])

    def sample(self) -> None:
        """Read everything once in each way."""
        begun = time.perf_counter()
        _read(self._words)
        alone = time.perf_counter()
        list(self._pool.map(_read, self._parts))
        self._took[0].append(alone - begun)
        self._took[1].append(time.perf_counter() - alone)

    @property
    def bytes_per_second(self) -> float:
        """The median of the faster way. StatisticsError before the first sample."""
        return self._words.nbytes / min(map(median, self._took))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()


@dataclass(slots=True)
class Touched:
    """Bytes of codes and rows that were read."""

    size_bytes: int = 0


@contextlib.contextmanager
def touched() -> Iterator[Touched]:
    """Counts what searches by codes read while the block runs: their loops are told which rows."""
    count = Touched()

    def counted(name: str, bytes_of: Any) -> Any:
        loop = getattr(cascade, name)

        def call(*arguments: Any) -> Any:
            count.size_bytes += bytes_of(*arguments)
            return loop(*arguments)

        return patch.object(cascade, name, call)

    with (
        counted("distances", lambda *a: 8 * len(a[3]) * int(np.count_nonzero(a[2][a[4] : a[5]]))),
        counted("distances_at", lambda at, query, out: 8 * len(query) * len(at)),
        counted("weighted_at", lambda at, planes, out: 8 * planes.shape[1] * len(at)),
        counted("products_at", lambda at, query, out: 4 * len(query) * len(at)),
    ):
        yield count


def private_bytes() -> int:
    """Memory of this process that is no file's: what mapped files take is the system's cache."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return 1024 * int(line.split()[1])
    raise AssertionError("Linux tells RssAnon")
