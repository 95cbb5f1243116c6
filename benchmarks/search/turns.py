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

from benchmarks.report import Spread
from benchmarks.search.comparison import CASES, OURS, Case, Compared, Row
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
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.chunks import Rows
from shared.codes.signs import SignCodes, sign_codes

# So long BLAS' threads look for more work before they sleep, on a core that the next method needs.
REST_SECONDS = 0.05


def load(world: World) -> SearchWorker:
    """A search worker that has loaded the map."""
    worker = SearchWorker(world.catalog, world.store, world.settings)
    worker.follow()
    status = worker.status()
    assert not status.missing, status.missing
    assert status.rows == len(world.photo_ids), "every photo can be found"
    return worker


def compare(world: World, city: City, queries: int, progress: Progress) -> Compared:
    """All cases with `queries` each."""
    task = progress.add_task("asking", total=len(CASES) * queries)
    photos = len(world.photo_ids)
    asked = np.concatenate([city.revisits(photos, queries), city.elsewhere(queries)])
    oracle = Oracle.of(_stored(world), world.photo_ids, asked)
    before = private_bytes()
    worker = load(world)
    grown = private_bytes() - before
    took: dict[str, dict[str, list[float]]] = {}
    differ: Counter[tuple[str, str]] = Counter()
    draw = random.Random(city.seed)
    with ReadSpeed() as speed, _methods(world, worker, asked) as (methods, ours):
        for case in CASES:
            numbers = range(queries) if case.matched else range(queries, 2 * queries)
            took[case.name] = {method.name: [] for method in methods}
            for method in methods:
                method.search(Asked(numbers[0], case.k, case.min_score))  # compiles, maps
            for number in numbers:
                question = Asked(number, case.k, case.min_score)
                expected = oracle.best(number, case.k, case.min_score)
                for method in draw.sample(methods, len(methods)):
                    time.sleep(REST_SECONDS)
                    begun = time.perf_counter()
                    found = method.search(question)
                    took[case.name][method.name].append(time.perf_counter() - begun)
                    right = same if method.name in OURS else same_photos
                    differ[case.name, method.name] += not right(found, expected)
                speed.sample()
                progress.advance(task)
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
    world: World, worker: SearchWorker, queries: Rows
) -> Iterator[tuple[list[Method], Ours]]:
    index = faiss.IndexFlatIP(world.dimension)
    for rows in _stored(world):
        index.add(rows)
    photos = len(world.photo_ids)
    rows = faiss.rev_swig_ptr(index.get_xb(), photos * world.dimension)
    rows = rows.reshape(photos, world.dimension)
    ids = world.photo_ids
    ours = Ours(world, worker, queries)
    snapshot = worker.snapshot(world.generation_id, world.version)
    yield (
        [
            ours,
            OurWorker(world, worker, queries, ours),
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
