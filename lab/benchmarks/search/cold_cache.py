"""Search latency when the descriptors are on disk and not in the page cache."""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import time

import numpy as np
from rich.progress import Progress

from lab.benchmarks.report import LatencySummary, Report
from lab.benchmarks.search.brute_force import BruteForce, Ranking, same_ranking
from lab.benchmarks.search.methods import SearchMethod, load_worker, placewise_search
from lab.benchmarks.search.synthetic_map import SyntheticCity, SyntheticMap
from services.search.snapshot import Snapshot
from shared.storage.chunks import Row

TARGET_SLOWDOWN = 5.0  # p95 of cold queries over p95 of warm ones
K = 10
MAX_CACHED_SHARE = 0.01  # of the rows' pages; with more the cache was not cold


def measure_cold_cache(
    report: Report, world: SyntheticMap, city: SyntheticCity, queries: int, bar: Progress
) -> None:
    """Time each query warm, then with all rows dropped from the page cache (not the codes).

    A page that a process has mapped cannot be dropped. Its mapping is released first
    (MADV_DONTNEED), then the file's pages (posix_fadvise DONTNEED); `mincore` reports what remains.
    """
    gc.collect()  # releases the mappings of earlier searches
    task = bar.add_task("cold", total=queries)
    query_rows = city.revisits(len(world.photo_ids), queries)
    pieces = (np.load(path, mmap_mode="r") for path in world.chunk_paths())
    oracle = BruteForce.of(pieces, world.photo_ids, query_rows)
    worker = load_worker(world)
    snapshot = worker.snapshot(world.generation_id, world.version)
    ours = placewise_search(world, worker)
    warm, cold, cached, differ = [], [], [], 0
    for number, row in enumerate(query_rows):
        ours(row, K, None)
        warm.append(_time_search(ours, row)[0])
        _drop_page_cache(snapshot, world)
        cached.append(_cached_share(snapshot))
        seconds, found = _time_search(ours, row)
        cold.append(seconds)
        differ += not same_ranking(found, oracle.best(number, K))
        bar.advance(task)
    report.add("cold: wrong results", differ, at_most=0)
    report.add("cold: share of pages still cached", max(cached), at_most=MAX_CACHED_SHARE)
    report.add_latency("cold: warm query", warm)
    report.add_latency("cold: query", cold)
    ratio = LatencySummary.of(cold).p95 / LatencySummary.of(warm).p95
    report.add("cold: p95 / p95 of a warm query", ratio, "x", at_most=TARGET_SLOWDOWN)
    report.details["cold"] = {"warm_seconds": warm, "cold_seconds": cold, "cached": cached}


def _drop_page_cache(snapshot: Snapshot, world: SyntheticMap) -> None:
    """Drop the chunks' rows from the page cache."""
    for chunk in snapshot.chunks:
        assert chunk.stored is not None, "a loaded chunk is on disk"
        chunk.stored.file.memory.madvise(mmap.MADV_DONTNEED)
    for path in world.chunk_paths():
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _cached_share(snapshot: Snapshot) -> float:
    """Return the share of the rows' pages that are in memory."""
    libc = ctypes.CDLL(None, use_errno=True)
    cached_pages = pages = 0
    for chunk in snapshot.chunks:
        assert chunk.stored is not None
        memory = chunk.stored.file.memory
        address = np.frombuffer(memory, np.uint8).ctypes.data
        count = -(-len(memory) // mmap.PAGESIZE)
        found = np.empty(count, np.uint8)
        room = ctypes.c_void_p(found.ctypes.data)
        if libc.mincore(ctypes.c_void_p(address), ctypes.c_size_t(len(memory)), room) != 0:
            raise OSError(ctypes.get_errno(), "mincore")
        cached_pages += int(np.count_nonzero(found & 1))
        pages += count
    return cached_pages / pages


def _time_search(search: SearchMethod, row: Row) -> tuple[float, Ranking]:
    started_at = time.perf_counter()
    found = search(row, K, None)
    return time.perf_counter() - started_at, found
