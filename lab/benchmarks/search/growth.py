"""Scan time of the sign codes as the map grows; the codes are random words."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import median
from typing import Self

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from lab.benchmarks.report import Report
from services.search.sign_code_search import SignCodeBlocks, SignCodedQuery, scan_first_level
from shared.codes.jit import REORDERED_FASTMATH, numba_jit
from shared.codes.rotation import get_rotation
from shared.codes.sign_codes import level_ends

DIMENSION = 98_304
MEASURED_SIZES = (100_000, 1_000_000)
BLOCK_ROWS = 1000  # rows per chunk
ROUNDS = 15
TARGET_RATIO = 1.3
SEED = 20_261_121

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

    A context manager of reads of `words`, which are larger than any CPU cache. Samples are taken
    between other measurements, so that other load on the machine affects both.
    """

    def __init__(self, words: Words) -> None:
        self._words = words.ravel()
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


def measure_growth(
    report: Report, progress: Progress, sizes: Sequence[int] = MEASURED_SIZES
) -> None:
    """Report the latency of scans, and its ratio to reading the same codes from memory."""
    task = progress.add_task("growth", total=len(sizes) * ROUNDS)
    for rows in sizes:
        codes, scan = _make_scan(rows)
        durations = []
        with MemoryBandwidth(codes) as bandwidth:
            for _ in range(ROUNDS):
                started_at = time.perf_counter()
                scan()
                durations.append(time.perf_counter() - started_at)
                bandwidth.sample()
                progress.advance(task)
        report.add_latency(f"growth: scan of {rows:,} codes", durations)
        ratio = median(durations) * bandwidth.bytes_per_second / codes.nbytes
        report.add(f"growth: {rows:,} codes, time / reading", ratio, "x", at_most=TARGET_RATIO)


def _make_scan(rows: int) -> tuple[Words, Callable[[], object]]:
    """Return (rows, words) random first-level codes and a compiled scan of them for one query."""
    rotation = get_rotation(DIMENSION)
    words = int(level_ends(rotation.padded)[0])
    rng = np.random.default_rng(SEED)
    query = SignCodedQuery.of(rng.standard_normal(DIMENSION).astype(np.float32), rotation)
    codes = np.frombuffer(rng.bytes(8 * rows * words), np.uint64).reshape(rows, words)
    blocks, mask = _blocks(codes), np.ones(rows, bool)

    def scan() -> object:
        return scan_first_level(blocks, [query], [mask])

    scan()  # compiles
    return codes, scan


def _blocks(codes: Words) -> SignCodeBlocks:
    """Return (rows, words) first-level codes as `scan_first_level` takes them, by chunk."""
    begins = np.arange(0, len(codes), BLOCK_ROWS)
    nothing = np.empty(0, np.uint64)
    return SignCodeBlocks(
        dimension=DIMENSION,
        first_rows=np.array([*begins, len(codes)], np.int64),
        level_addresses=(codes.ctypes.data + begins * codes.strides[0]).astype(np.uint64)[
            np.newaxis
        ],
        row_addresses=nothing,
        number_bytes=np.empty(0, np.int64),
        norms=np.ones(len(codes), np.float32),
        zero_rows=np.empty(0, np.int64),
        keep_alive=codes,
    )
