"""Scan time of the sign codes as the map grows; the codes are random words."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from statistics import median

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from lab.benchmarks.report import Report
from lab.benchmarks.search.memory_traffic import MemoryBandwidth
from services.search.sign_code_search import SignCodeBlocks, SignCodedQuery, scan_first_level
from shared.codes.rotation import get_rotation
from shared.codes.sign_codes import level_ends

DIMENSION = 98_304
MEASURED_SIZES = (100_000, 1_000_000)
BLOCK_ROWS = 1000  # rows per chunk
ROUNDS = 15
TARGET_RATIO = 1.3
SEED = 20_261_121


def measure_growth(
    report: Report, progress: Progress, sizes: Sequence[int] = MEASURED_SIZES
) -> None:
    """Report the latency of scans, and its ratio to reading the same codes from memory."""
    task = progress.add_task("growth", total=len(sizes) * ROUNDS)
    for rows in sizes:
        codes, scan = make_scan(rows)
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


def make_scan(rows: int) -> tuple[NDArray[np.uint64], Callable[[], object]]:
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


def _blocks(codes: NDArray[np.uint64]) -> SignCodeBlocks:
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
