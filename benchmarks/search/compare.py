"""Every query through every method in turn: a busy machine is busy for all of them."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median

import faiss
import numpy as np
from rich.table import Table

from benchmarks.report import Report, Spread
from benchmarks.search.memory import ReadSpeed, private_bytes
from benchmarks.search.methods import (
    Asked,
    BinaryFlat,
    FlatIP,
    Method,
    NumpyResident,
    Ours,
    OurWorker,
    Predecessor,
)
from benchmarks.search.oracle import Oracle, same, same_photos
from benchmarks.search.places import City
from benchmarks.search.world import World
from services.search.follow import advance
from services.search.load import Loader
from services.search.memory import Memory
from services.search.snapshot import Snapshot
from shared.chunks import Rows
from shared.codes.signs import SignCodes, sign_codes
from shared.shards import WHOLE

OURS = (Ours.name, OurWorker.name)
BOUNDS_AT = (10_000, 98_304)
"""Photos and dimension for which figures are wanted."""
AS_FAST = 1.1  # of two medians of one run: less is the clock's noise


@dataclass(frozen=True, slots=True)
class Case:
    """Queries of one kind. `matched`: their places are in the map."""

    name: str
    matched: bool
    k: int
    min_score: float | None = None


MATCHED = Case("in the map, k=10", True, 10)
OUTSIDE = Case("not in the map, k=10", False, 10)
WITH_FLOOR = Case("not in the map, k=10, min_score=0.3", False, 10, 0.3)
CASES = (
    MATCHED,
    Case("in the map, k=1", True, 1),
    Case("in the map, k=100", True, 100),
    OUTSIDE,
    WITH_FLOOR,
)


@dataclass(frozen=True, slots=True)
class Row:
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
class Compared:
    """All cases of one size of map."""

    photos: int
    dimension: int
    rows: list[Row]
    read_bytes_per_second: float
    grown_bytes: int
    """Private memory that loading the map took."""
    certificates: list[str]
    took: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    """Seconds of each query, by case and method."""

    def row(self, case: Case, method: str) -> Row:
        return next(row for row in self.rows if (row.case, row.method) == (case.name, method))

    def ratio(self, case: Case, method: str) -> float:
        """How many times longer the method takes than ours."""
        return self.row(case, method).median_ms / self.row(case, Ours.name).median_ms

    def as_json(self) -> dict[str, object]:
        return {**asdict(self), "rows": [asdict(row) for row in self.rows]}

    def table(self) -> Table:
        table = Table(
            *("queries", "method", "median", "p95", "x ours", "memory", "touched", "x floor"),
            *("asked", "differ"),
            title=f"{self.photos:,} photos, {self.dimension:,} dimensions",
        )
        for case in CASES:
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


def load(world: World) -> Snapshot:
    """The map as a search worker loads it."""
    loader = Loader(world.store, world.settings.search_cache(WHOLE))
    memory = Memory(world.settings.search_memory_bytes)
    snapshot = advance(world.catalog, loader, memory, world.generation_id, None)
    assert snapshot is not None, "the generation is there"
    assert not snapshot.missing, snapshot.missing
    return snapshot


def compare(world: World, city: City, queries: int, advanced: Callable[[], object]) -> Compared:
    """All cases with `queries` each; `advanced` is called after each query."""
    photos = len(world.photo_ids)
    asked = np.concatenate([city.revisits(photos, queries), city.elsewhere(queries)])
    oracle = Oracle.of(_stored(world), world.photo_ids, asked)
    before = private_bytes()
    snapshot = load(world)
    grown = private_bytes() - before
    speed = ReadSpeed()
    took: dict[str, dict[str, list[float]]] = {}
    differ: Counter[tuple[str, str]] = Counter()
    with _methods(world, snapshot, asked) as (methods, ours):
        for case in CASES:
            numbers = range(queries) if case.matched else range(queries, 2 * queries)
            took[case.name] = {method.name: [] for method in methods}
            for method in methods:
                method.search(Asked(numbers[0], case.k, case.min_score))  # compiles, maps
            for turn, number in enumerate(numbers):
                question = Asked(number, case.k, case.min_score)
                expected = oracle.best(number, case.k, case.min_score)
                first = turn % len(methods)
                for method in (*methods[first:], *methods[:first]):
                    begun = time.perf_counter()
                    found = method.search(question)
                    took[case.name][method.name].append(time.perf_counter() - begun)
                    right = same if method.name in OURS else same_photos
                    differ[case.name, method.name] += not right(found, expected)
                speed.sample()
                advanced()
        rows = [
            _row(case, method, took[case.name][method.name], differ, speed, queries)
            for case in CASES
            for method in methods
        ]
        return Compared(
            photos=photos,
            dimension=world.dimension,
            rows=rows,
            read_bytes_per_second=speed.bytes_per_second,
            grown_bytes=grown,
            certificates=sorted(ours.certificates),
            took=took,
        )


def tell(report: Report, compared: Compared) -> None:
    """Put what is wanted of a comparison into the report."""
    c = compared
    wanted = (c.photos, c.dimension) == BOUNDS_AT
    size = f"{c.photos:,} x {c.dimension:,}"
    ours = c.row(MATCHED, Ours.name)
    memory = max(c.grown_bytes, ours.memory_bytes)
    report.add(f"{size}: our answers that differ", _differ(c, OURS), at_most=0)
    report.add(f"{size}: {MATCHED.name}, median", ours.median_ms, "ms")
    for case, method, least in (
        (MATCHED, NumpyResident.name, 40),
        (MATCHED, FlatIP.name, 100),
        (MATCHED, Predecessor.name, 300),
        (OUTSIDE, NumpyResident.name, 6),
    ):
        report.add(
            f"{size}: {case.name}, {method} takes",
            c.ratio(case, method),
            "x ours",
            at_least=least if wanted else None,
        )
    report.add(
        f"{size}: {MATCHED.name}, of reading what it reads",
        ours.floor_ratio,
        "x",
        at_most=4 if wanted else None,
    )
    report.add(
        f"{size}: {WITH_FLOOR.name}, of a matched query",
        c.row(WITH_FLOOR, Ours.name).median_ms / ours.median_ms,
        "x",
        at_most=AS_FAST if wanted else None,
    )
    report.add(
        f"{size}: float32 rows, of what the index holds",
        4 * c.photos * c.dimension / memory,
        "x",
        at_least=25 if wanted else None,
    )


def _differ(compared: Compared, methods: Sequence[str]) -> int:
    return sum(row.differ for row in compared.rows if row.method in methods)


def _row(
    case: Case,
    method: Method,
    took: list[float],
    differ: Counter[tuple[str, str]],
    speed: ReadSpeed,
    queries: int,
) -> Row:
    spread = Spread.of(took)
    first = 0 if case.matched else queries
    reads = int(
        median(
            method.bytes_touched(Asked(first + number, case.k, case.min_score))
            for number in range(len(took))
        )
    )
    return Row(
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


@contextlib.contextmanager
def _methods(
    world: World, snapshot: Snapshot, queries: Rows
) -> Iterator[tuple[list[Method], Ours]]:
    index = faiss.IndexFlatIP(world.dimension)
    for rows in _stored(world):
        index.add(rows)
    photos = len(world.photo_ids)
    rows = faiss.rev_swig_ptr(index.get_xb(), photos * world.dimension)
    rows = rows.reshape(photos, world.dimension)
    ids = world.photo_ids
    ours = Ours(snapshot, queries)
    yield (
        [
            ours,
            OurWorker(world, queries, ours),
            NumpyResident(rows, ids, queries),
            FlatIP(index, ids, queries),
            BinaryFlat(_codes(snapshot, rows), rows, ids, queries),
            Predecessor(world.chunk_paths(), ids, queries),
        ],
        ours,
    )


def _codes(snapshot: Snapshot, rows: Rows) -> SignCodes:
    """Those of the snapshot, or made here where it does without."""
    codes = [chunk.codes for chunk in snapshot.chunks if chunk.codes is not None]
    if len(codes) < len(snapshot.chunks):
        return sign_codes(rows)
    levels = zip(*(code.levels for code in codes), strict=True)
    norms = np.concatenate([code.norms for code in codes])
    return SignCodes(tuple(np.concatenate(level) for level in levels), norms)


def _stored(world: World) -> Iterator[Rows]:
    """The rows of each chunk, mapped from its file."""
    for path in world.chunk_paths():
        yield np.load(path, mmap_mode="r")
