"""What a comparison of methods has found, and what of it is wanted."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from rich.table import Table

from benchmarks.report import Report
from benchmarks.search.methods import (
    AnyLocSearch,
    FaissFlat,
    NumpySearch,
    PlacewiseSearch,
    PlacewiseWorker,
)

PLACEWISE_METHODS = (PlacewiseSearch.name, PlacewiseWorker.name)
TARGET_MAP_SIZE = (10_000, 98_304)
"""Photos and dimension for which figures are wanted."""
NOISE_FACTOR = 1.1  # of two medians of one run: less is the clock's noise


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
    """What one method did in one case."""

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
    """All cases of one size of map."""

    photos: int
    dimension: int
    rows: list[MethodTiming]
    read_bytes_per_second: float
    grown_bytes: int
    """Private memory that loading the map took."""
    certificates: list[str]
    took: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    """Seconds of each query, by case and method."""

    def row(self, case: QueryCase, method: str) -> MethodTiming:
        return next(row for row in self.rows if (row.case, row.method) == (case.name, method))

    def ratio(self, case: QueryCase, method: str) -> float:
        """How many times longer the method takes than ours."""
        return self.row(case, method).median_ms / self.row(case, PlacewiseSearch.name).median_ms

    def as_json(self) -> dict[str, object]:
        return {**asdict(self), "rows": [asdict(row) for row in self.rows]}

    def table(self) -> Table:
        table = Table(
            *("queries", "method", "median", "p95", "x ours", "memory", "touched", "x floor"),
            *("asked", "differ"),
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
    """Put what is wanted of a comparison into the report."""
    c = compared
    wanted = (c.photos, c.dimension) == TARGET_MAP_SIZE
    size = f"{c.photos:,} x {c.dimension:,}"
    ours = c.row(MATCHED_CASE, PlacewiseSearch.name)
    memory = max(c.grown_bytes, ours.memory_bytes)
    report.add(
        f"{size}: our answers that differ",
        sum(row.differ for row in c.rows if row.method in PLACEWISE_METHODS),
        at_most=0,
    )
    report.add(f"{size}: {MATCHED_CASE.name}, median", ours.median_ms, "ms")
    for case, method, least in (
        (MATCHED_CASE, NumpySearch.name, 40),
        (MATCHED_CASE, FaissFlat.name, 100),
        (MATCHED_CASE, AnyLocSearch.name, 300),
        (OUT_OF_MAP_CASE, NumpySearch.name, 6),
    ):
        report.add(
            f"{size}: {case.name}, {method} takes",
            c.ratio(case, method),
            "x ours",
            at_least=least if wanted else None,
        )
    report.add(
        f"{size}: {MATCHED_CASE.name}, of reading what it reads",
        ours.floor_ratio,
        "x",
        at_most=4 if wanted else None,
    )
    report.add(
        f"{size}: {MIN_SCORE_CASE.name}, of a matched query",
        c.row(MIN_SCORE_CASE, PlacewiseSearch.name).median_ms / ours.median_ms,
        "x",
        at_most=NOISE_FACTOR if wanted else None,
    )
    report.add(
        f"{size}: float32 rows, of what the index holds",
        4 * c.photos * c.dimension / memory,
        "x",
        at_least=25 if wanted else None,
    )
