"""Search latency against exact rivals; every result is compared with brute force in float64.

    placewise bench search [--photos 2000] [--dimensions 512,7168,98304]

A generated map of VLAD-like descriptors (`synthetic_map`) is searched by Placewise, NumPy, faiss
and by loading every chunk. Columns: best, p50 and p95 of a query; p50 divided by that of Placewise;
queries with a wrong result. The largest map is also searched with its rows dropped from the page
cache (`cold`). Every query is run with all methods in turn, so that other load affects all of them.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from uuid import UUID

import faiss
import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import Progress

from lab.benchmarks.report import LatencySummary, Report, integers_option, printed_report
from lab.benchmarks.synthetic_map import (
    CHUNK_ROWS,
    SyntheticCity,
    SyntheticMap,
    create_synthetic_map,
    required_memory_bytes,
)
from services.cli.output import JsonOption, Table
from services.search.executor import execute_query
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.storage.chunks import CODED_DIMENSION, Row, Rows
from tests.support.memory import memory_bytes

SEED = 20_261_121
PLACEWISE = "Placewise, execute_query()"
NUMPY = "NumPy, resident float32"
FAISS_FLAT = "faiss.IndexFlatIP"
FAISS_PANORAMA = "faiss.IndexFlatIPPanorama"
ALL_CHUNKS = "np.load of every chunk"
PANORAMA_LEVELS = 8  # as in faiss' own benchmark of it
TARGET_MAP_SIZE = (10_000, 98_304)
"""Photos and dimension that the targets are for."""
NOISE_FACTOR = 1.1  # ratio of two medians of a run; smaller differences are timing noise
PAUSE_SECONDS = 0.05
"""BLAS' threads look for more work so long before they sleep, on a core that the next method
needs."""

Ranking = Sequence[tuple[UUID, float]]
"""Photos with their cosines, best first."""
SearchMethod = Callable[[Row, int], Ranking]
"""Searches with a (dimension,) row, the number of results and the minimum score."""


@dataclass(frozen=True, slots=True)
class QueryCase:
    """Queries of one kind. `matched`: their places are in the map."""

    name: str
    matched: bool
    k: int


MATCHED_CASE = QueryCase("in the map, k=10", True, 10)
OUT_OF_MAP_CASE = QueryCase("not in the map, k=10", False, 10)
QUERY_CASES = (
    MATCHED_CASE,
    QueryCase("in the map, k=1", True, 1),
    QueryCase("in the map, k=100", True, 100),
    OUT_OF_MAP_CASE,
)


def bench(
    photos: Annotated[
        Any, integers_option("Numbers of photos in the map, comma-separated.")
    ] = "2000",
    dimensions: Annotated[
        Any, integers_option("Descriptor dimensions, multiples of 64, comma-separated.")
    ] = "512,7168,98304",
    queries: Annotated[int, typer.Option(min=2, help="Queries of each kind.")] = 20,
    folder: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Folder for the map, on a real disk: 600 kB per photo of 98,304 dimensions.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare search latency with NumPy, faiss and full chunk reads, and check the results."""
    with printed_report("Search", as_json) as (report, progress):
        report.details["comparisons"] = []
        for dimension in sorted(dimensions, reverse=True):
            city = SyntheticCity(dimension, SEED)
            for count in photos:
                with tempfile.TemporaryDirectory(dir=folder, prefix="placewise-bench-") as home:
                    making = progress.add_task(f"{count:,} x {dimension:,}", total=count)
                    with create_synthetic_map(
                        Path(home, "home"),
                        dimension,
                        search_memory_budget=required_memory_bytes(count, dimension),
                    ) as world:
                        for rows in city.chunks(count, CHUNK_ROWS):
                            world.add(rows)
                            progress.advance(making, len(rows))
                        compare_methods(report, world, city, queries, progress)
                        if (count, dimension) == (max(photos), max(dimensions)):
                            measure_cold_cache(report, world, city, queries, progress)


DECIMALS = 12  # scores equal to this precision are ties, which are ordered by photo id
TOLERANCE = 1e-9  # of a score; float64 sums of 98,304 products differ by less than 1e-14


class BruteForce:
    """Ground truth of searches: float64 cosines of n photos with (q, dimension) queries.

    `pieces` are the photos' L2-normalised rows, in the order of `photo_ids`.
    """

    def __init__(self, pieces: Sequence[Rows], photo_ids: Sequence[UUID], queries: Rows) -> None:
        unit_queries = queries.astype(np.float64)
        unit_queries /= np.linalg.norm(unit_queries, axis=1, keepdims=True)
        blocks = [rows[b : b + 128] for rows in pieces for b in range(0, len(rows), 128)]
        scores = [unit_queries @ block.astype(np.float64).T for block in blocks]
        self._photo_ids = photo_ids
        self._scores = np.round(np.concatenate(scores, axis=1), DECIMALS)

    @classmethod
    def of_map(cls, world: SyntheticMap, queries: Rows) -> BruteForce:
        pieces = [np.load(path, mmap_mode="r") for path in world.chunk_paths()]
        return cls(pieces, world.photo_ids, queries)

    def best(self, query: int, k: int) -> Ranking:
        """Return the result of query number `query`."""
        scores = self._scores[query]
        k = min(k, len(scores))
        kth = np.partition(scores, len(scores) - k)[len(scores) - k]
        candidates = np.flatnonzero(scores >= kth)
        ranked = sorted((-float(scores[row]), self._photo_ids[row]) for row in candidates.tolist())
        return [(photo_id, -score) for score, photo_id in ranked[:k]]


def same_ranking(found: Ranking, expected: Ranking, tolerance: float = TOLERANCE) -> bool:
    """Return whether photos and order are equal and scores differ by at most `tolerance`."""
    return len(found) == len(expected) and all(
        ours[0] == truth[0] and abs(ours[1] - truth[1]) <= tolerance
        for ours, truth in zip(found, expected, strict=True)
    )


def load_worker(world: SyntheticMap) -> tuple[SearchWorker, Snapshot]:
    """Return a search worker that has loaded the map, and its snapshot of it."""
    worker = SearchWorker(world.catalog, world.store, world.settings)
    worker.sync()
    status = worker.status()
    assert not status.missing, status.missing
    assert status.rows == len(world.photo_ids), "every photo can be found"
    return worker, worker.snapshot(world.generation_id, world.version)


def placewise_search(worker: SearchWorker, snapshot: Snapshot) -> SearchMethod:
    """Return Placewise's search on the loaded snapshot, called directly."""

    def search(query: Row, k: int) -> Ranking:
        found = execute_query(snapshot, query, snapshot.photos.findable, k, worker.query_batcher)
        return [(hit.photo_id, hit.score) for hit in found.hits]

    return search


def rival_methods(world: SyntheticMap, folder: Path) -> dict[str, SearchMethod]:
    """Return the other methods by name, over float32 copies of the map's rows.

    NumPy and `IndexFlatIP` share one array. Chunks are loaded for each query, as AnyLoc's
    similarity service does, from copies in `folder`.
    """
    ids = world.photo_ids
    flat = faiss.IndexFlatIP(world.dimension)
    paths = []
    for number, path in enumerate(world.chunk_paths()):
        stored = np.load(path).astype(np.float32)
        flat.add(stored)
        paths.append(folder / f"{number}.npy")
        np.save(paths[-1], stored)
    rows: Rows = faiss.rev_swig_ptr(flat.get_xb(), len(ids) * world.dimension)
    rows = rows.reshape(len(ids), world.dimension)
    panorama = faiss.IndexFlatIPPanorama(world.dimension, PANORAMA_LEVELS)
    panorama.add(rows)

    def numpy_search(query: Row, k: int) -> Ranking:
        return _top_k(rows @ query, ids, k)

    def load_all_chunks(query: Row, k: int) -> Ranking:
        scores = np.concatenate([np.dot(np.load(path), query) for path in paths])
        return _top_k(scores, ids, k)

    return {
        NUMPY: numpy_search,
        FAISS_FLAT: _faiss_search(flat, ids),
        FAISS_PANORAMA: _faiss_search(panorama, ids),
        ALL_CHUNKS: load_all_chunks,
    }


def _faiss_search(index: faiss.Index, ids: Sequence[UUID]) -> SearchMethod:
    def search(query: Row, k: int) -> Ranking:
        scores, rows = index.search(query[np.newaxis], min(k, len(ids)))
        found = zip(rows[0].tolist(), scores[0].tolist(), strict=True)
        return [(ids[row], score) for row, score in found]

    return search


def _top_k(scores: NDArray[np.float32], ids: Sequence[UUID], k: int) -> Ranking:
    """Return the top k of the scores of all rows, which are in the order of the photos."""
    k = min(k, len(scores))
    best = np.argpartition(scores, len(scores) - k)[len(scores) - k :]
    best = best[np.argsort(-scores[best], kind="stable")]
    return [(ids[row], float(scores[row])) for row in best.tolist()]


def compare_methods(
    report: Report,
    world: SyntheticMap,
    city: SyntheticCity,
    queries: int,
    progress: Progress,
    make_search: Callable[[SearchWorker, Snapshot], SearchMethod] = placewise_search,
) -> None:
    """Run all cases with `queries` queries each, and report them with the targets of the map."""
    task = progress.add_task("searching", total=len(QUERY_CASES) * queries)
    photos = len(world.photo_ids)
    rows = np.concatenate([city.revisits(photos, queries), city.out_of_map_rows(queries)])
    oracle = BruteForce.of_map(world, rows)
    before = memory_bytes("RssAnon")
    worker, snapshot = load_worker(world)
    index_bytes = max(memory_bytes("RssAnon") - before, worker.status().resident_bytes)
    seconds: dict[tuple[str, str], list[float]] = {}
    wrong: Counter[tuple[str, str]] = Counter()
    draw = random.Random(city.seed)
    with tempfile.TemporaryDirectory(dir=world.settings.placewise_home) as folder:
        methods = {
            PLACEWISE: make_search(worker, snapshot),
            **rival_methods(world, Path(folder)),
        }
        for case in QUERY_CASES:
            numbers = range(queries) if case.matched else range(queries, 2 * queries)
            for name, search in methods.items():
                seconds[case.name, name] = []
                search(rows[numbers[0]], case.k)  # compiles, maps
            for number in numbers:
                expected = oracle.best(number, case.k)
                for name in draw.sample(list(methods), len(methods)):
                    time.sleep(PAUSE_SECONDS)
                    started_at = time.perf_counter()
                    found = methods[name](rows[number], case.k)
                    seconds[case.name, name].append(time.perf_counter() - started_at)
                    # The others compute scores in float32.
                    tolerance = TOLERANCE if name == PLACEWISE else np.inf
                    wrong[case.name, name] += not same_ranking(found, expected, tolerance)
                progress.advance(task)
    took = {key: LatencySummary.of(values) for key, values in seconds.items()}
    _report_table(report, photos, world.dimension, took, wrong)
    _report_targets(report, photos, world.dimension, took, wrong, index_bytes)


def _report_table(
    report: Report,
    photos: int,
    dimension: int,
    took: dict[tuple[str, str], LatencySummary],
    wrong: Counter[tuple[str, str]],
) -> None:
    table = Table(
        *("queries", "method", "best", "p50", "p95", "/ Placewise", "wrong"),
        title=f"{photos:,} photos, {dimension:,} dimensions",
    )
    rows = []
    for (case, method), of_method in took.items():
        best, p50, p95 = (1000 * s for s in (of_method.best, of_method.median, of_method.p95))
        ratio = of_method.median / took[case, PLACEWISE].median
        errors = wrong[case, method]
        times = tuple(f"{milliseconds:,.2f} ms" for milliseconds in (best, p50, p95))
        values = *times, f"{ratio:,.2f}", str(errors)
        table.add_row(case, method, *values, end_section=method == ALL_CHUNKS)
        rows.append(
            {
                "case": case,
                "method": method,
                "best_ms": best,
                "p50_ms": p50,
                "p95_ms": p95,
                "wrong": errors,
            }
        )
    report.tables.append(table)
    comparisons = report.details.setdefault("comparisons", [])
    comparisons.append({"photos": photos, "dimension": dimension, "rows": rows})


def _report_targets(
    report: Report,
    photos: int,
    dimension: int,
    took: dict[tuple[str, str], LatencySummary],
    wrong: Counter[tuple[str, str]],
    index_bytes: int,
) -> None:
    """Report what the map's size has targets for; `index_bytes`: memory taken for the map."""
    has_targets = (photos, dimension) == TARGET_MAP_SIZE
    size = f"{photos:,} x {dimension:,}"
    errors = sum(wrong[case.name, PLACEWISE] for case in QUERY_CASES)
    report.add(f"{size}: wrong results of Placewise", errors, at_most=0)
    ours = took[MATCHED_CASE.name, PLACEWISE]
    report.add(f"{size}: {MATCHED_CASE.name}, p50", 1000 * ours.median, "ms")
    report.add(f"{size}: {MATCHED_CASE.name}, p95", 1000 * ours.p95, "ms")
    for case, method, least in (
        (MATCHED_CASE, NUMPY, 40),
        (MATCHED_CASE, FAISS_FLAT, 100),
        (MATCHED_CASE, FAISS_PANORAMA, 1),
        (MATCHED_CASE, ALL_CHUNKS, 300),
        (OUT_OF_MAP_CASE, NUMPY, 6),
        (OUT_OF_MAP_CASE, FAISS_PANORAMA, 1),
    ):
        ratio = took[case.name, method].median / took[case.name, PLACEWISE].median
        target = least if has_targets else None
        report.add(f"{size}: {case.name}, {method} / Placewise", ratio, "x", at_least=target)
    if dimension < CODED_DIMENSION:
        fastest = min(took[MATCHED_CASE.name, name].best for name in (NUMPY, FAISS_PANORAMA))
        report.add(
            f"{size}: {MATCHED_CASE.name}, best / that of NumPy or Panorama",
            ours.best / fastest,
            "x",
            at_most=NOISE_FACTOR,
        )
    report.add(
        f"{size}: memory of the index / float32 rows",
        index_bytes / (4 * photos * dimension),
        "x",
        at_most=1 / 25 if has_targets else None,
    )


TARGET_SLOWDOWN = 5.0  # p95 of cold queries over p95 of warm ones
COLD_K = 10
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
    oracle = BruteForce.of_map(world, query_rows)
    worker, snapshot = load_worker(world)
    ours = placewise_search(worker, snapshot)
    mappings = [chunk.stored.file.memory for chunk in snapshot.chunks if chunk.stored is not None]
    assert len(mappings) == len(snapshot.chunks), "a loaded chunk is on disk"
    warm, cold, cached, differ = [], [], [], 0
    for number, row in enumerate(query_rows):
        ours(row, COLD_K)
        started_at = time.perf_counter()
        ours(row, COLD_K)
        warm.append(time.perf_counter() - started_at)
        for memory in mappings:
            memory.madvise(mmap.MADV_DONTNEED)
        for path in world.chunk_paths():
            with path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        cached.append(float(np.mean(np.concatenate(list(map(_cached_pages, mappings))))))
        started_at = time.perf_counter()
        found = ours(row, COLD_K)
        cold.append(time.perf_counter() - started_at)
        differ += not same_ranking(found, oracle.best(number, COLD_K))
        bar.advance(task)
    report.add("cold: wrong results", differ, at_most=0)
    report.add("cold: share of pages still cached", max(cached), at_most=MAX_CACHED_SHARE)
    report.add_latency("cold: warm query", warm)
    report.add_latency("cold: query", cold)
    ratio = LatencySummary.of(cold).p95 / LatencySummary.of(warm).p95
    report.add("cold: p95 / p95 of a warm query", ratio, "x", at_most=TARGET_SLOWDOWN)
    report.details["cold"] = {"warm_seconds": warm, "cold_seconds": cold, "cached": cached}


def _cached_pages(memory: mmap.mmap) -> NDArray[np.bool_]:
    """Return which pages of a mapping are in memory."""
    address = ctypes.c_void_p(np.frombuffer(memory, np.uint8).ctypes.data)
    found = np.empty(-(-len(memory) // mmap.PAGESIZE), np.uint8)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mincore(address, ctypes.c_size_t(len(memory)), found.ctypes.data_as(ctypes.c_void_p)):
        raise OSError(ctypes.get_errno(), "mincore")
    return (found & 1).astype(bool)
