"""Every query through every method in turn: a busy machine is busy for all of them."""

from __future__ import annotations

import contextlib
import random
import time
from collections import Counter
from collections.abc import Iterator
from statistics import median

import faiss
import numpy as np
from rich.progress import Progress

from benchmarks.report import LatencySummary
from benchmarks.search.comparison import (
    PLACEWISE_METHODS,
    QUERY_CASES,
    MethodComparison,
    MethodTiming,
    QueryCase,
)
from benchmarks.search.memory import MemoryBandwidth, private_bytes
from benchmarks.search.methods import (
    AnyLocSearch,
    BenchmarkQuery,
    FaissBinary,
    FaissFlat,
    NumpySearch,
    PlacewiseSearch,
    PlacewiseWorker,
    SearchMethod,
)
from benchmarks.search.oracle import BruteForce, same_photos, same_ranking
from benchmarks.search.places import SyntheticCity
from benchmarks.search.world import SyntheticMap
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.chunks import Rows
from shared.codes.signs import SignCodes, encode_signs

# So long BLAS' threads look for more work before they sleep, on a core that the next method needs.
PAUSE_SECONDS = 0.05


def load_worker(world: SyntheticMap) -> SearchWorker:
    """A search worker that has loaded the map."""
    worker = SearchWorker(world.catalog, world.store, world.settings)
    worker.sync()
    status = worker.status()
    assert not status.missing, status.missing
    assert status.rows == len(world.photo_ids), "every photo can be found"
    return worker


def compare_methods(
    world: SyntheticMap, city: SyntheticCity, queries: int, progress: Progress
) -> MethodComparison:
    """All cases with `queries` each."""
    task = progress.add_task("asking", total=len(QUERY_CASES) * queries)
    photos = len(world.photo_ids)
    asked = np.concatenate([city.revisits(photos, queries), city.out_of_map_rows(queries)])
    oracle = BruteForce.of(_stored_rows(world), world.photo_ids, asked)
    before = private_bytes()
    worker = load_worker(world)
    grown = private_bytes() - before
    took: dict[str, dict[str, list[float]]] = {}
    differ: Counter[tuple[str, str]] = Counter()
    draw = random.Random(city.seed)
    with MemoryBandwidth() as speed, _make_methods(world, worker, asked) as (methods, ours):
        for case in QUERY_CASES:
            numbers = range(queries) if case.matched else range(queries, 2 * queries)
            took[case.name] = {method.name: [] for method in methods}
            for method in methods:
                method.search(BenchmarkQuery(numbers[0], case.k, case.min_score))  # compiles, maps
            for number in numbers:
                question = BenchmarkQuery(number, case.k, case.min_score)
                expected = oracle.best(number, case.k, case.min_score)
                for method in draw.sample(methods, len(methods)):
                    time.sleep(PAUSE_SECONDS)
                    begun = time.perf_counter()
                    found = method.search(question)
                    took[case.name][method.name].append(time.perf_counter() - begun)
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
            read_bytes_per_second=speed.bytes_per_second,
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


@contextlib.contextmanager
def _make_methods(
    world: SyntheticMap, worker: SearchWorker, queries: Rows
) -> Iterator[tuple[list[SearchMethod], PlacewiseSearch]]:
    index = faiss.IndexFlatIP(world.dimension)
    for rows in _stored_rows(world):
        index.add(rows)
    photos = len(world.photo_ids)
    rows = faiss.rev_swig_ptr(index.get_xb(), photos * world.dimension)
    rows = rows.reshape(photos, world.dimension)
    ids = world.photo_ids
    ours = PlacewiseSearch(world, worker, queries)
    snapshot = worker.snapshot(world.generation_id, world.version)
    yield (
        [
            ours,
            PlacewiseWorker(world, worker, queries, ours),
            NumpySearch(rows, ids, queries),
            FaissFlat(index, ids, queries),
            FaissBinary(_sign_codes_of(snapshot, rows), rows, ids, queries),
            AnyLocSearch(world.chunk_paths(), ids, queries),
        ],
        ours,
    )


def _sign_codes_of(snapshot: Snapshot, rows: Rows) -> SignCodes:
    """Those of the snapshot, or made here where it does without."""
    codes = [chunk.codes for chunk in snapshot.chunks if chunk.codes is not None]
    if len(codes) < len(snapshot.chunks):
        return encode_signs(rows)
    levels = zip(*(code.levels for code in codes), strict=True)
    norms = np.concatenate([code.norms for code in codes])
    return SignCodes(tuple(np.concatenate(level) for level in levels), norms)


def _stored_rows(world: SyntheticMap) -> Iterator[Rows]:
    """The rows of each chunk, mapped from its file."""
    for path in world.chunk_paths():
        yield np.load(path, mmap_mode="r")
