"""Compares search methods on the same queries, and reports the results with their targets.

Every query is run with all methods in turn, so that other load affects all of them.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import Progress

from lab.benchmarks.report import LatencySummary, Report
from lab.benchmarks.search.brute_force import TOLERANCE, BruteForce, same_ranking
from lab.benchmarks.search.methods import (
    ALL_CHUNKS,
    FAISS_FLAT,
    FAISS_PANORAMA,
    NUMPY,
    PLACEWISE,
    load_worker,
    placewise_search,
    rival_methods,
)
from lab.benchmarks.search.synthetic_map import SyntheticCity, SyntheticMap
from services.cli.output import Table
from tests.support.memory import memory_bytes

TARGET_MAP_SIZE = (10_000, 98_304)
"""Photos and dimension that the targets are for."""
NOISE_FACTOR = 1.1  # ratio of two medians of a run; smaller differences are timing noise
PAUSE_SECONDS = 0.05
"""BLAS' threads look for more work so long before they sleep, on a core that the next method
needs."""


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


@dataclass(slots=True)
class MethodComparison:
    """All cases of one map size."""

    photos: int
    dimension: int
    index_bytes: int
    """Memory that Placewise has taken for the map."""
    took: dict[tuple[str, str], LatencySummary]
    """By case and method."""
    wrong: Counter[tuple[str, str]]
    """Answers that were not those of brute force, by case and method."""

    def ratio(self, case: QueryCase, method: str) -> float:
        """Return the method's median divided by that of Placewise."""
        return self.took[case.name, method].median / self.took[case.name, PLACEWISE].median

    def table(self) -> Table:
        table = Table(
            *("queries", "method", "p50", "p95", "/ Placewise", "wrong"),
            title=f"{self.photos:,} photos, {self.dimension:,} dimensions",
        )
        for case in QUERY_CASES:
            for name, method in self.took:
                if name == case.name:
                    took = self.took[name, method]
                    table.add_row(
                        name,
                        method,
                        f"{1000 * took.median:,.2f} ms",
                        f"{1000 * took.p95:,.2f} ms",
                        f"{self.ratio(case, method):,.2f}",
                        str(self.wrong[name, method]),
                    )
            table.add_section()
        return table

    def as_json(self) -> dict[str, object]:
        rows = [
            {
                "case": case,
                "method": method,
                "p50_ms": 1000 * took.median,
                "p95_ms": 1000 * took.p95,
                "wrong": self.wrong[case, method],
            }
            for (case, method), took in self.took.items()
        ]
        return {"photos": self.photos, "dimension": self.dimension, "rows": rows}


def report_comparison(report: Report, compared: MethodComparison) -> None:
    """Add a comparison to the report, with the bounds that it must meet."""
    has_targets = (compared.photos, compared.dimension) == TARGET_MAP_SIZE
    size = f"{compared.photos:,} x {compared.dimension:,}"
    wrong = sum(compared.wrong[case.name, PLACEWISE] for case in QUERY_CASES)
    report.add(f"{size}: wrong results of Placewise", wrong, at_most=0)
    ours = compared.took[MATCHED_CASE.name, PLACEWISE]
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
        ratio = compared.ratio(case, method)
        target = least if has_targets else None
        report.add(f"{size}: {case.name}, {method} / Placewise", ratio, "x", at_least=target)
    min_score = compared.took[MIN_SCORE_CASE.name, PLACEWISE].median / ours.median
    memory = compared.index_bytes / (4 * compared.photos * compared.dimension)
    for what, value, most in (
        (f"{MIN_SCORE_CASE.name} / in the map", min_score, NOISE_FACTOR),
        ("memory of the index / float32 rows", memory, 1 / 25),
    ):
        report.add(f"{size}: {what}", value, "x", at_most=most if has_targets else None)


def compare_methods(
    world: SyntheticMap, city: SyntheticCity, queries: int, progress: Progress
) -> MethodComparison:
    """Run all cases with `queries` queries each."""
    task = progress.add_task("searching", total=len(QUERY_CASES) * queries)
    photos = len(world.photo_ids)
    rows = np.concatenate([city.revisits(photos, queries), city.out_of_map_rows(queries)])
    stored = (np.load(path, mmap_mode="r") for path in world.chunk_paths())
    oracle = BruteForce.of(stored, world.photo_ids, rows)
    before = memory_bytes("RssAnon")
    worker = load_worker(world)
    grown = memory_bytes("RssAnon") - before
    seconds: dict[tuple[str, str], list[float]] = {}
    wrong: Counter[tuple[str, str]] = Counter()
    draw = random.Random(city.seed)
    with tempfile.TemporaryDirectory(dir=world.settings.placewise_home) as folder:
        methods = {
            PLACEWISE: placewise_search(world, worker),
            **rival_methods(world, Path(folder)),
        }
        for case in QUERY_CASES:
            numbers = range(queries) if case.matched else range(queries, 2 * queries)
            for name, search in methods.items():
                seconds[case.name, name] = []
                search(rows[numbers[0]], case.k, case.min_score)  # compiles, maps
            for number in numbers:
                expected = oracle.best(number, case.k, case.min_score)
                for name in draw.sample(list(methods), len(methods)):
                    time.sleep(PAUSE_SECONDS)
                    started_at = time.perf_counter()
                    found = methods[name](rows[number], case.k, case.min_score)
                    seconds[case.name, name].append(time.perf_counter() - started_at)
                    # The others compute scores in float32.
                    tolerance = TOLERANCE if name == PLACEWISE else np.inf
                    wrong[case.name, name] += not same_ranking(found, expected, tolerance)
                progress.advance(task)
    return MethodComparison(
        photos=photos,
        dimension=world.dimension,
        index_bytes=max(grown, worker.status().resident_bytes),
        took={key: LatencySummary.of(values) for key, values in seconds.items()},
        wrong=wrong,
    )
