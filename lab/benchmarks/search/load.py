"""Correctness under load: clients search while photos are added, deleted and merged.

The search service runs in a process of its own, as in production. Each response names the version
of the map that it refers to, and is compared with brute force on the photos of that version.
"""

from __future__ import annotations

import bisect
import contextlib
import random
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from http.client import HTTPException

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from rich.progress import Progress

from lab.benchmarks.fleet.load_generator import HttpCaller
from lab.benchmarks.fleet.service import ServiceProcess
from lab.benchmarks.report import Report
from lab.benchmarks.search.methods import BruteForce, Ranking, same_ranking
from lab.benchmarks.search.synthetic_map import SyntheticCity, SyntheticMap
from shared.search_api.protocol import SearchResponse
from shared.storage.chunks import Rows
from tests.support.processes import PLACEWISE
from tests.support.server import environment
from tests.support.servers.daemon import free_ports

CLIENTS = 32
QUERIES = 48
OUT_OF_MAP_QUERIES = 16  # of them
TOP_KS = (1, 10, 100)
ADDED_PHOTOS = 240  # photos that are added during the load
CHANGE_SECONDS = 0.25
CHANGES_PER_MERGE = 20
MAX_SIMILARITY = 0.8  # maximum share of another photo's content in an added photo
SEED = 20_261_121
JSON_HEADERS = {"Content-Type": "application/json"}


@dataclass(frozen=True, slots=True)
class SearchObservation:
    query: int
    k: int
    least_version: int
    """Lowest version of the map that the response may refer to."""
    response: SearchResponse
    seconds: float


@dataclass(slots=True)
class LoadOutcome:
    """Responses and changes recorded during the load."""

    answered: list[SearchObservation] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    versions: list[int] = field(default_factory=list)
    """Ascending."""
    live: list[NDArray[np.bool_]] = field(default_factory=list)
    """Mask of the photos that are in the map at each of the versions."""
    merges: int = 0
    seconds: float = 0.0

    def live_at(self, version: int) -> int:
        """Return a version's index in `live`; ValueError for a version before the first."""
        found = bisect.bisect_right(self.versions, version) - 1
        if found < 0:
            raise ValueError(f"version {version} is older than all")
        return found


def measure_load(
    report: Report, world: SyntheticMap, city: SyntheticCity, seconds: float, progress: Progress
) -> None:
    """Run CLIENTS clients for `seconds`."""
    photos = len(world.photo_ids)
    paths = world.chunk_paths()
    queries = np.concatenate(
        [
            city.revisits(photos, QUERIES - OUT_OF_MAP_QUERIES),
            city.out_of_map_rows(OUT_OF_MAP_QUERIES),
        ]
    )
    pool = _similar_rows(queries, city.out_of_map_rows(OUT_OF_MAP_QUERIES + 1)[OUT_OF_MAP_QUERIES:])
    with _start_search_service(world) as url, HttpCaller(url) as caller:
        outcome = _Load(world, caller, queries, pool).run(seconds, progress)
    pieces: Iterator[Rows] = (np.load(path, mmap_mode="r") for path in paths)
    added = len(world.photo_ids) - photos
    stored = pool[:added].astype(world.row_type)
    oracle = BruteForce.of((*pieces, stored), world.photo_ids, queries)
    wrong = count_wrong_answers(outcome, oracle)
    report.add("load: results", len(outcome.answered), at_least=1)
    report.add("load: versions of the map", len(outcome.versions) + outcome.merges, at_least=2)
    report.add("load: wrong results", wrong, at_most=0)
    report.add("load: errors", len(outcome.failed), at_most=0)
    report.add("load: throughput", len(outcome.answered) / outcome.seconds, "queries/s")
    report.add_latency("load: query", [answered.seconds for answered in outcome.answered])
    report.details["load"] = {"added": added, "errors": outcome.failed[:20]}


def count_wrong_answers(outcome: LoadOutcome, oracle: BruteForce) -> int:
    """Count responses that differ from brute force on their version, or are too old."""
    expected: dict[tuple[int, int, int], Ranking] = {}
    wrong = 0
    for answered in outcome.answered:
        response = answered.response
        if response.snapshot_version < answered.least_version or response.missing:
            wrong += 1
            continue
        at = outcome.live_at(response.snapshot_version), answered.query, answered.k
        if at not in expected:
            live = np.zeros(len(oracle.photo_ids), bool)
            live[: len(outcome.live[at[0]])] = outcome.live[at[0]]
            expected[at] = oracle.best(answered.query, answered.k, live=live)
        found = [(hit.photo_id, hit.score) for hit in response.hits]
        wrong += not same_ranking(found, expected[at])
    return wrong


class _Load:
    """Clients that search, and a thread that changes the map meanwhile."""

    def __init__(self, world: SyntheticMap, caller: HttpCaller, queries: Rows, pool: Rows) -> None:
        self._world, self._caller, self._pool = world, caller, pool
        self._keys = [world.store_query(row) for row in queries]
        self._stop = threading.Event()
        self._outcome = LoadOutcome(
            versions=[world.version], live=[np.ones(len(world.photo_ids), bool)]
        )

    def run(self, seconds: float, progress: Progress) -> LoadOutcome:
        task = progress.add_task("load", total=seconds)
        for query, k in enumerate(TOP_KS):  # compiles the kernels
            self._send_query(query, k)
        self._outcome.answered.clear()
        with ThreadPoolExecutor(CLIENTS + 1) as threads:
            started_at = time.monotonic()
            loops = [threads.submit(self._search_loop, number) for number in range(CLIENTS)]
            loops.append(threads.submit(self._change_loop))
            try:
                while (spent := time.monotonic() - started_at) < seconds:
                    progress.update(task, completed=spent)
                    if any(loop.done() for loop in loops):
                        break  # its exception is raised below
                    time.sleep(0.1)
            finally:
                self._stop.set()
            for loop in loops:
                loop.result()
            self._outcome.seconds = time.monotonic() - started_at
        return self._outcome

    def _search_loop(self, number: int) -> None:
        draw = random.Random(SEED + number)
        while not self._stop.is_set():
            self._send_query(draw.randrange(len(self._keys)), draw.choice(TOP_KS))

    def _send_query(self, query: int, k: int) -> None:
        outcome = self._outcome
        least = outcome.versions[-1]
        body = self._world.request(self._keys[query], k, least).model_dump_json().encode()
        started_at = time.perf_counter()
        try:
            answer = self._caller.call("POST", "/search", body, **JSON_HEADERS)
            took = time.perf_counter() - started_at
            if answer.status == 200:
                response = SearchResponse.model_validate_json(answer.body)
                outcome.answered.append(SearchObservation(query, k, least, response, took))
            else:
                outcome.failed.append(f"{answer.status}: {answer.body[:200]!r}")
        except (OSError, HTTPException, ValidationError) as error:
            outcome.failed.append(f"{type(error).__name__}: {error}")

    def _change_loop(self) -> None:
        """Add a photo, delete another one, and merge the added chunks from time to time."""
        world, draw = self._world, random.Random(SEED)
        slot = len(world.photo_ids)  # beyond those in use
        added = turn = 0
        live = self._outcome.live[-1]
        while not self._stop.wait(CHANGE_SECONDS):
            turn += 1
            if added < len(self._pool):
                version = world.add(self._pool[added : added + 1], slot)
                added += 1
                live = np.append(live, True)
                self._record_version(version, live)
            deleted = int(draw.choice(np.flatnonzero(live).tolist()))
            version = world.delete(world.photo_ids[deleted])
            live = live.copy()
            live[deleted] = False
            self._record_version(version, live)
            if turn % CHANGES_PER_MERGE == 0 and world.merge(slot):
                self._outcome.merges += 1

    def _record_version(self, version: int, live: NDArray[np.bool_]) -> None:
        self._outcome.live.append(live)
        self._outcome.versions.append(version)  # last: clients require it from now on


def _similar_rows(queries: Rows, others: Rows) -> Rows:
    """Return (POOL, dimension) rows of photos that match the queries to different degrees."""
    draw = np.random.default_rng(SEED)
    rows = queries[draw.integers(len(queries), size=ADDED_PHOTOS)]
    for row in rows:  # one after the other: the pool alone is large enough
        row += draw.uniform(0.1, 2 * MAX_SIMILARITY) * others[draw.integers(len(others))]
        noise = draw.standard_normal(len(row)).astype(np.float32)
        row += np.float32(draw.uniform(0.2, 1.0)) * noise / np.linalg.norm(noise)
        row /= np.linalg.norm(row)
    return rows


@contextlib.contextmanager
def _start_search_service(world: SyntheticMap) -> Iterator[str]:
    """Start `placewise search` on the map; yields its URL."""
    (port,) = free_ports(1)
    home = world.settings.placewise_home
    service = ServiceProcess(
        "search",
        [PLACEWISE, "search"],
        environment(home, port=port, search_memory_budget=world.settings.search_memory_bytes),
        home / "search.log",
        f"http://127.0.0.1:{port}/readyz",
    )
    service.start()
    try:
        service.wait_until_ready()
        yield f"http://127.0.0.1:{port}"
    finally:
        service.kill()
