"""Compares search methods on the same queries, and reports the results with their targets.

Every query is run with all methods in turn, so that other load affects all of them.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median

import faiss
import numpy as np
from rich.progress import Progress

from lab.benchmarks.report import LatencySummary, Report
from lab.benchmarks.search.memory_traffic import MemoryBandwidth
from lab.benchmarks.search.methods import (
    AnyLocSearch,
    BenchmarkQuery,
    BruteForce,
    FaissBinary,
    FaissFlat,
    FaissPanorama,
    NumpySearch,
    PlacewiseSearch,
    PlacewiseWorker,
    SearchMethod,
    same_photos,
    same_ranking,
)
from lab.benchmarks.search.synthetic_map import SyntheticCity, SyntheticMap
from services.cli.output import Table
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.codes.sign_codes import SignCodes, encode_signs
from shared.storage.chunks import Rows
from tests.support.memory import memory_bytes

PLACEWISE_METHODS = (PlacewiseSearch.name, PlacewiseWorker.name)
TARGET_MAP_SIZE = (10_000, 98_304)
"""Photos and dimension that the targets are for."""
NOISE_FACTOR = 1.1  # ratio of two medians of a run; smaller differences are timing noise


@dataclass(frozen=True, slots=True)
class QueryCase:
    """Queries of one kind. `matched`: their places are in the map."""

    name: str
    matched: bool
    k: int
    min_score: float | None = None


MATCHED_CASE = QueryCase("in the map, k=10", True, 10)
OUT_OF_MAP_CASE = QueryCase("not in the map, k=10", False, 10)
MIN_SCORE_CASE = QueryCase("not in the map, k=10, min_score=0.3", False, 10, 0.3)
QUERY_CASES = (
    MATCHED_CASE,
    QueryCase("in the map, k=1", True, 1),
    QueryCase("in the map, k=100", True, 100),
    OUT_OF_MAP_CASE,
    MIN_SCORE_CASE,
)


@dataclass(frozen=True, slots=True)
class MethodTiming:
    """Timings of one method in one case."""

    case: str
    method: str
    median_ms: float
    p95_ms: float
    memory_bytes: int
    bytes_touched: int
    floor_ratio: float
    """Of the median, to reading those bytes as fast as this machine reads memory."""
    queries: int
    differ: int
    """Answers that were not those of brute force."""


@dataclass(slots=True)
class MethodComparison:
    """All cases of one map size."""

    photos: int
    dimension: int
    rows: list[MethodTiming]
    grown_bytes: int
    """Private memory that loading the map took."""
    certificates: list[str]
    took: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    """Seconds of each query, by case and method."""

    def row(self, case: QueryCase, method: str) -> MethodTiming:
        return next(row for row in self.rows if (row.case, row.method) == (case.name, method))

    def ratio(self, case: QueryCase, method: str) -> float:
        """Return the method's time divided by that of Placewise."""
        return self.row(case, method).median_ms / self.row(case, PlacewiseSearch.name).median_ms

    def as_json(self) -> dict[str, object]:
        return {**asdict(self), "rows": [asdict(row) for row in self.rows]}

    def table(self) -> Table:
        table = Table(
            *("queries", "method", "p50", "p95", "/ Placewise", "index", "bytes read", "/ reading"),
            *("number", "wrong"),
            title=f"{self.photos:,} photos, {self.dimension:,} dimensions",
        )
        for case in QUERY_CASES:
            for row in (row for row in self.rows if row.case == case.name):
                table.add_row(
                    row.case,
                    row.method,
                    f"{row.median_ms:,.2f} ms",
                    f"{row.p95_ms:,.2f} ms",
                    f"{self.ratio(case, row.method):,.2f}",
                    f"{row.memory_bytes / 1e6:,.1f} MB",
                    f"{row.bytes_touched / 1e6:,.1f} MB",
                    f"{row.floor_ratio:,.2f}",
                    str(row.queries),
                    str(row.differ),
                )
            table.add_section()
        return table


def report_comparison(report: Report, compared: MethodComparison) -> None:
    """Add a comparison to the report, with the bounds that it must meet."""
    has_targets = (compared.photos, compared.dimension) == TARGET_MAP_SIZE
    size = f"{compared.photos:,} x {compared.dimension:,}"
    ours = compared.row(MATCHED_CASE, PlacewiseSearch.name)
    memory = max(compared.grown_bytes, ours.memory_bytes)
    wrong = sum(row.differ for row in compared.rows if row.method in PLACEWISE_METHODS)
    report.add(f"{size}: wrong results of Placewise", wrong, at_most=0)
    report.add(f"{size}: {MATCHED_CASE.name}, p50", ours.median_ms, "ms")
    report.add(f"{size}: {MATCHED_CASE.name}, p95", ours.p95_ms, "ms")
    for case, method, least in (
        (MATCHED_CASE, NumpySearch.name, 40),
        (MATCHED_CASE, FaissFlat.name, 100),
        (MATCHED_CASE, FaissPanorama.name, 1),
        (MATCHED_CASE, AnyLocSearch.name, 300),
        (OUT_OF_MAP_CASE, NumpySearch.name, 6),
        (OUT_OF_MAP_CASE, FaissPanorama.name, 1),
    ):
        ratio = compared.ratio(case, method)
        target = least if has_targets else None
        report.add(f"{size}: {case.name}, {method} / Placewise", ratio, "x", at_least=target)
    min_score = compared.row(MIN_SCORE_CASE, PlacewiseSearch.name).median_ms / ours.median_ms
    rows_bytes = 4 * compared.photos * compared.dimension
    for what, value, most in (
        (f"{MATCHED_CASE.name}, time / reading those bytes", ours.floor_ratio, 4),
        (f"{MIN_SCORE_CASE.name} / in the map", min_score, NOISE_FACTOR),
        ("memory of the index / float32 rows", memory / rows_bytes, 1 / 25),
    ):
        report.add(f"{size}: {what}", value, "x", at_most=most if has_targets else None)


PANORAMA_LEVELS = 8  # as in faiss' own benchmark of it

# So long BLAS' threads look for more work before they sleep, on a core that the next method needs.
PAUSE_SECONDS = 0.05


def load_worker(world: SyntheticMap) -> SearchWorker:
    """Return a search worker that has loaded the map."""
    worker = SearchWorker(world.catalog, world.store, world.settings)
    worker.sync()
    status = worker.status()
    assert not status.missing, status.missing
    assert status.rows == len(world.photo_ids), "every photo can be found"
    return worker


def compare_methods(
    world: SyntheticMap, city: SyntheticCity, queries: int, progress: Progress
) -> MethodComparison:
    """Run all cases with `queries` queries each."""
    task = progress.add_task("searching", total=len(QUERY_CASES) * queries)
    photos = len(world.photo_ids)
    query_rows = np.concatenate([city.revisits(photos, queries), city.out_of_map_rows(queries)])
    oracle = BruteForce.of(_stored_rows(world), world.photo_ids, query_rows)
    before = memory_bytes("RssAnon")
    worker = load_worker(world)
    grown = memory_bytes("RssAnon") - before
    took: dict[str, dict[str, list[float]]] = {}
    differ: Counter[tuple[str, str]] = Counter()
    draw = random.Random(city.seed)
    with (
        MemoryBandwidth() as speed,
        tempfile.TemporaryDirectory(dir=world.settings.placewise_home) as folder,
    ):
        methods, ours = _make_methods(world, worker, query_rows, Path(folder))
        for case in QUERY_CASES:
            numbers = range(queries) if case.matched else range(queries, 2 * queries)
            took[case.name] = {method.name: [] for method in methods}
            for method in methods:
                method.search(BenchmarkQuery(numbers[0], case.k, case.min_score))  # compiles, maps
            for number in numbers:
                query = BenchmarkQuery(number, case.k, case.min_score)
                expected = oracle.best(number, case.k, case.min_score)
                for method in draw.sample(methods, len(methods)):
                    time.sleep(PAUSE_SECONDS)
                    started_at = time.perf_counter()
                    found = method.search(query)
                    took[case.name][method.name].append(time.perf_counter() - started_at)
                    right = same_ranking if method.name in PLACEWISE_METHODS else same_photos
                    differ[case.name, method.name] += not right(found, expected)
                speed.sample()
                progress.advance(task)
        rows = [
            _summarise_timing(case, method, took[case.name][method.name], differ, speed, queries)
            for case in QUERY_CASES
            for method in methods
        ]
        return MethodComparison(
            photos=photos,
            dimension=world.dimension,
            rows=rows,
            grown_bytes=grown,
            certificates=sorted(ours.certificates),
            took=took,
        )


def _summarise_timing(
    case: QueryCase,
    method: SearchMethod,
    took: list[float],
    differ: Counter[tuple[str, str]],
    speed: MemoryBandwidth,
    queries: int,
) -> MethodTiming:
    spread = LatencySummary.of(took)
    first = 0 if case.matched else queries
    reads = int(
        median(
            method.bytes_touched(BenchmarkQuery(first + number, case.k, case.min_score))
            for number in range(len(took))
        )
    )
    return MethodTiming(
        case=case.name,
        method=method.name,
        median_ms=1000 * spread.median,
        p95_ms=1000 * spread.p95,
        memory_bytes=method.memory_bytes,
        bytes_touched=reads,
        floor_ratio=spread.median * speed.bytes_per_second / reads,
        queries=len(took),
        differ=differ[case.name, method.name],
    )


def _make_methods(
    world: SyntheticMap, worker: SearchWorker, queries: Rows, folder: Path
) -> tuple[list[SearchMethod], PlacewiseSearch]:
    """Return all methods, and Placewise's; the others search float32 copies of its stored rows."""
    index = faiss.IndexFlatIP(world.dimension)
    paths = []
    for number, stored in enumerate(_stored_rows(world)):
        float32_rows = stored.astype(np.float32)
        index.add(float32_rows)
        paths.append(folder / f"{number}.npy")
        np.save(paths[-1], float32_rows)
    photos = len(world.photo_ids)
    rows = faiss.rev_swig_ptr(index.get_xb(), photos * world.dimension)
    rows = rows.reshape(photos, world.dimension)
    panorama = faiss.IndexFlatIPPanorama(world.dimension, PANORAMA_LEVELS)
    panorama.add(rows)
    ids = world.photo_ids
    ours = PlacewiseSearch(world, worker, queries)
    snapshot = worker.snapshot(world.generation_id, world.version)
    methods: list[SearchMethod] = [
        ours,
        PlacewiseWorker(world, worker, ours),
        NumpySearch(ids, queries, rows),
        FaissFlat(ids, queries, index),
        FaissPanorama(ids, queries, panorama),
        FaissBinary(ids, queries, rows, _sign_codes_of(snapshot, rows)),
        AnyLocSearch(ids, queries, paths),
    ]
    return methods, ours


def _sign_codes_of(snapshot: Snapshot, rows: Rows) -> SignCodes:
    """Return the snapshot's sign codes; compute them if it has none."""
    codes = [chunk.codes for chunk in snapshot.chunks if chunk.codes is not None]
    if len(codes) < len(snapshot.chunks):
        return encode_signs(rows)
    levels = zip(*(code.levels for code in codes), strict=True)
    norms = np.concatenate([code.norms for code in codes])
    return SignCodes(tuple(np.concatenate(level) for level in levels), norms)


def _stored_rows(world: SyntheticMap) -> Iterator[Rows]:
    """Map the rows of each chunk from its file."""
    for path in world.chunk_paths():
        yield np.load(path, mmap_mode="r")
