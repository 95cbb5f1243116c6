"""Faults of each service and server under uploads and queries: no photo is lost, doubled or stuck.

`make test-chaos` injects the faults of SHORT, of a second each, `PLACEWISE_TEST_CHAOS=30 make
test-chaos` all of them, of 30 seconds. Those on one component are also in the other modules of
this folder, in tests/contract/storage (a store that is full, refuses, cuts or is slow) and in
tests/integration (a search worker that is silent or killed, messages that are doubled or lost).
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self
from uuid import UUID

import httpx2
import pytest

from tests.support.clock import clock_off_by
from tests.support.fault_injection import MessageDuplicator, ProxyMode
from tests.support.fleet import Fleet, open_fleet
from tests.support.invariants import count_unfinished_jobs, find_violations
from tests.support.photos import photo_bytes
from tests.support.server import SERVICES_KEY
from tests.support.servers.handle import Handle
from tests.support.waiting import wait_until

pytestmark = pytest.mark.timeout(900)

# Services whose clock is wrong during the whole run, by so many seconds. S3 servers reject what is
# signed with a clock that is off by more than 900.
CLOCK_OFFSETS_SECONDS = {
    "gateway-1": 600,
    "extractor-1": 600,
    "extractor-2": -600,
    "search-1": -600,
    "steward-0": 600,
}
SHORT = {
    "kill -9 of gateway-0",
    "kill -9 of extractor-0",
    "kill -9 of every service at once",
    "an extractor stands still beyond its lease",
    "Redis stopped",
    "PostgreSQL stopped",
    "the S3 store killed",
}
FAULT_SECONDS = float(os.environ.get("PLACEWISE_TEST_CHAOS") or 1)
IS_SHORT = FAULT_SECONDS <= 1
PHOTOS = 2 if IS_SHORT else 24  # before, during and after each fault
QUERIES = 3 if IS_SHORT else 10  # after each fault
QUERY_INTERVAL_SECONDS = 1.0 if IS_SHORT else 0.1
SEED = 20_261_121


@dataclass(frozen=True, slots=True)
class Fault:
    """`begin` breaks a component, and `end` repairs it."""

    name: str
    begin: Callable[[Fleet], object]
    end: Callable[[Fleet], object]
    seconds: float = 0.0
    """How long it lasts"""


def _kill(name: str) -> Fault:
    return Fault(
        f"kill -9 of {name}", lambda fleet: fleet[name].kill(), lambda fleet: fleet.start(name)
    )


def _pause(title: str, name: str) -> Fault:
    def resume(fleet: Fleet) -> None:
        time.sleep(2 * fleet.lease_seconds)
        fleet[name].signal(signal.SIGCONT)

    return Fault(title, lambda fleet: fleet[name].signal(signal.SIGSTOP), resume)


def _stop(
    title: str,
    server: str,
    seconds: float = FAULT_SECONDS,
    begin: Callable[[Handle], object] = Handle.kill,
    end: Callable[[Handle], object] = Handle.start,
) -> Fault:
    return Fault(
        title,
        lambda fleet: begin(fleet.servers.processes[server]),
        lambda fleet: end(fleet.servers.processes[server]),
        seconds,
    )


def _disconnect(title: str, server: str, mode: ProxyMode) -> Fault:
    return Fault(
        title,
        lambda fleet: fleet.servers.proxies[server].set_mode(mode),
        lambda fleet: fleet.servers.proxies[server].set_mode(ProxyMode.OPEN),
        FAULT_SECONDS,
    )


def _duplicate_messages() -> Fault:
    stack = contextlib.ExitStack()
    return Fault(
        "every message doubled",
        lambda fleet: stack.enter_context(MessageDuplicator(fleet.servers.redis.url).duplicating()),
        lambda fleet: stack.close(),
        FAULT_SECONDS,
    )


FAULTS = [
    *map(_kill, ("gateway-0", "extractor-0", "search-0", "search-1", "steward-0")),
    Fault("kill -9 of every service at once", Fleet.kill_all, Fleet.start),
    _pause("an extractor stands still beyond its lease", "extractor-0"),
    _pause("a search worker stands still", "search-0"),
    Fault("FLUSHALL", lambda f: f.servers.redis.flush(), lambda f: f.servers.redis.flush()),
    _stop("Redis stopped", "Redis"),
    _stop("Redis stopped for two minutes", "Redis", 120.0),
    *(_stop(f"Redis paused {n} s", "Redis", n, Handle.pause, Handle.resume) for n in (7, 16, 90)),
    Fault(
        "Redis full",
        lambda f: f.servers.redis.fill(),
        lambda f: f.servers.redis.empty(),
        FAULT_SECONDS,
    ),
    _duplicate_messages(),
    _stop("PostgreSQL killed and started", "PostgreSQL", 0.0),
    _stop("PostgreSQL stopped", "PostgreSQL"),
    _stop("the S3 store killed", "the S3 store"),
    _disconnect("the S3 store full (507)", "the S3 store", ProxyMode.FULL),
    *(
        _disconnect(f"connections to {server} {mode.name.lower()}", server, mode)
        for server in ("PostgreSQL", "Redis", "the S3 store")
        for mode in (ProxyMode.REFUSED, ProxyMode.CUT, ProxyMode.SLOW)
    ),
]

UPLOADERS = 4
CALL_TIMEOUT_SECONDS = 60.0
RETRY_SECONDS = 0.1
MIN_SELF_SCORE = 0.9999
RETRYABLE_STATUSES = (429, 503, 507)


class Traffic:
    """Uploads photos as they are released, and queries with them; retries at the next gateway."""

    def __init__(self, urls: Sequence[str]) -> None:
        self._random = random.Random(SEED)
        headers = {"Authorization": f"Bearer {SERVICES_KEY}"}
        self._clients = [
            httpx2.Client(base_url=url, headers=headers, timeout=CALL_TIMEOUT_SECONDS)
            for url in urls
        ]
        self._lock = threading.Lock()
        self._released = 0
        self._next = 0
        self._stop = threading.Event()
        self.querying = threading.Lock()
        """Held while a query is in progress."""
        self._numbers: dict[UUID, int] = {}
        self.acknowledged: dict[str, UUID] = {}
        self.known: list[int] = []
        """Numbers of photos that every result must contain."""
        self.answers: Counter[str] = Counter()
        """How calls went: `right`, `retried`"""
        self.violations: list[str] = []
        """Wrong answers, and responses that were neither an answer nor retryable"""
        self._threads = [
            *(threading.Thread(target=self._upload, args=(n,)) for n in range(UPLOADERS)),
            threading.Thread(target=self._query_loop),
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.daemon = True
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for client in self._clients:
            client.close()

    def release(self, photos: int) -> None:
        """Allow so many more photos to be uploaded."""
        self._released += photos

    @property
    def all_acknowledged(self) -> bool:
        return len(self.acknowledged) >= self._released

    def mark_searchable(self) -> None:
        """Require from now on that each result contains the acknowledged photos."""
        with self._lock:
            self.known = sorted(self._numbers.values())

    def _upload(self, caller: int) -> None:
        while not self._stop.is_set():
            with self._lock:
                number = self._next if self._next < self._released else None
                if number is not None:
                    self._next += 1
            if number is None:
                self._stop.wait(0.02)
                continue
            data = photo_bytes(number)
            tries = caller
            while not self._stop.is_set():
                body = self._call(
                    tries, "/api/v1/upload", (200, 202), files={"file": (f"{number}.jpg", data)}
                )
                if body is not None:
                    photo_id = UUID(body["file_id"])
                    with self._lock:
                        self.acknowledged[hashlib.sha256(data).hexdigest()] = photo_id
                        self._numbers[photo_id] = number
                    break
                tries += 1
                self._stop.wait(RETRY_SECONDS)

    def _query_loop(self) -> None:
        while not self._stop.wait(QUERY_INTERVAL_SECONDS):
            with self._lock:
                number = self._random.choice(self.known) if self.known else None
            if number is not None:
                with self.querying:
                    self.query(number)

    def query(self, number: int) -> None:
        """Query with the bytes of an acknowledged photo and check the result."""
        body = self._call(
            self._random.randrange(len(self._clients)),
            "/api/v1/similarity",
            (200, 202),
            files={"file": ("query.jpg", photo_bytes(number))},
            params={"top_k": 5},
            headers={"Prefer": "wait=10"},
        )
        if body is None or "similar_images" not in body or body["missing"]:
            return  # retried, not ready in time, or a chunk is missing
        found = body["similar_images"]
        ids = [photo["image_id"] for photo in found]
        if (
            found
            and self._numbers.get(UUID(ids[0])) == number
            and found[0]["similarity_score"] > MIN_SELF_SCORE
            and len(set(ids)) == len(ids)
        ):
            self.answers["right"] += 1
        else:
            self.violations.append(f"query with photo {number}: {found[:2]}")

    def _call(
        self, caller: int, path: str, expected: Sequence[int], **options: Any
    ) -> dict[str, Any] | None:
        """Return the response body; None if the caller should retry."""
        try:
            answer = self._clients[caller % len(self._clients)].post(path, **options)
        except httpx2.TransportError as error:
            self.answers["retried"] += 1
            if isinstance(error, httpx2.ReadTimeout):
                self.violations.append(f"{path} did not answer in {CALL_TIMEOUT_SECONDS:.0f} s")
            return None
        if answer.status_code in expected:
            body: dict[str, Any] = answer.json()
            return body
        if answer.status_code in RETRYABLE_STATUSES:
            self.answers["retried"] += 1
        else:
            self.violations.append(f"{path} answered {answer.status_code}: {answer.text[:500]}")
        return None


RECOVERY_SECONDS = 180.0  # jobs that are unfinished after it count as stuck
MAX_FAULT_DELAY_SECONDS = 0.5  # the fault starts this long after the uploads at the latest


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    with open_fleet(
        gateways=2,
        extractors=3,
        replicas=2,
        through_proxies=True,
        executed=not IS_SHORT,
        extractor="test-slow-avg:milliseconds=20,width=256",  # so that a kill finds it at work
        lease_seconds=2.0,
        batch_photos=8,
        chunk_rows=50,
    ) as opened:
        for name, seconds in CLOCK_OFFSETS_SECONDS.items():
            opened[name].environment.update(clock_off_by(seconds))
        opened.start()
        yield opened


@pytest.fixture(scope="module")
def traffic(fleet: Fleet) -> Iterator[Traffic]:
    with Traffic(fleet.gateway_urls) as running:
        yield running


@pytest.mark.parametrize(
    "fault",
    [fault for fault in FAULTS if not IS_SHORT or fault.name in SHORT],
    ids=lambda fault: fault.name,
)
def test_a_fault_loses_and_duplicates_no_photo_and_gives_no_wrong_answer(
    fleet: Fleet, traffic: Traffic, fault: Fault
) -> None:
    moments = random.Random(f"{SEED} {fault.name}")
    answers = traffic.answers.copy()
    traffic.release(PHOTOS)
    time.sleep(moments.uniform(0, MAX_FAULT_DELAY_SECONDS))
    fault.begin(fleet)
    try:
        traffic.release(PHOTOS)
        time.sleep(fault.seconds)
    finally:
        fault.end(fleet)
    repaired_at = time.monotonic()
    traffic.release(PHOTOS)
    wait_until(lambda: traffic.all_acknowledged, RECOVERY_SECONDS)
    wait_until(lambda: not count_unfinished_jobs(fleet.catalog, photos=True), RECOVERY_SECONDS)
    print(f"searchable again {time.monotonic() - repaired_at:.1f} s after: {fault.name}")
    traffic.mark_searchable()
    with traffic.querying:
        # The jobs of queries whose gateway was killed still complete, although nobody waits.
        wait_until(lambda: not count_unfinished_jobs(fleet.catalog), RECOVERY_SECONDS)
        found = find_violations(fleet.catalog, fleet.store, traffic.acknowledged)
    for known in moments.sample(traffic.known, min(QUERIES, len(traffic.known))):
        traffic.query(known)
    found += traffic.violations
    assert not found, "\n".join([*found, fleet.logs()])
    assert traffic.answers["right"] > answers["right"], "results were checked"
