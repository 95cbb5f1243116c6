"""Redis that stands still, is killed or full under load: photos are described, queries answered.

`placewise bench chaos` has the longer outages (90 s, two minutes).
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Self
from uuid import UUID

import httpx2
import pytest
from redis import Redis
from sqlalchemy import func, select
from sqlalchemy.orm import InstrumentedAttribute

from lab.benchmarks.fleet import Fleet, open_fleet
from lab.benchmarks.invariants import check_invariants, count_unfinished_jobs
from shared.jobs import Job
from shared.jobs.wakeups import WakeupQueue
from tests.support.photos import photo_bytes
from tests.support.server import SERVICES_KEY
from tests.support.waiting import wait_until

PHOTOS_PER_SECOND = 4.0
BEFORE_SECONDS = 10.0
RECOVERY_SECONDS = 15.0

pytestmark = [pytest.mark.servers, pytest.mark.timeout(900)]


numbers = itertools.count()
acknowledged: dict[str, UUID] = {}


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    with open_fleet(
        gateways=1,
        extractors=2,
        executed=False,
        extractor="test-slow-avg:milliseconds=5,width=256",
        lease_seconds=5.0,
        batch_photos=8,
    ) as opened:
        opened.start()
        with Load(opened, numbers) as load:  # extractors load what they need
            wait_until(lambda: len(load.acknowledged) > 0)
        wait_until(lambda: not count_unfinished_jobs(opened.catalog))
        acknowledged.update(load.acknowledged)
        yield opened


class Load:
    """Uploads photos at a steady rate, and asks with one of them every second."""

    def __init__(self, fleet: Fleet, numbers: Iterator[int]) -> None:
        self._fleet = fleet
        self._numbers = numbers
        self._stop = threading.Event()
        self.acknowledged: dict[str, UUID] = {}
        self.unanswered: list[str] = []
        self._threads = [threading.Thread(target=run) for run in (self._upload, self._ask)]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _client(self) -> httpx2.Client:
        headers = {"Authorization": f"Bearer {SERVICES_KEY}"}
        return httpx2.Client(base_url=self._fleet.gateway_urls[0], headers=headers, timeout=30)

    def _upload(self) -> None:
        with self._client() as client:
            while not self._stop.wait(1 / PHOTOS_PER_SECOND):
                number = next(self._numbers)
                data = photo_bytes(number)
                answer = client.post("/api/v1/upload", files={"file": (f"{number}.jpg", data)})
                assert answer.status_code == 202, answer.text
                self.acknowledged[hashlib.sha256(data).hexdigest()] = UUID(answer.json()["file_id"])

    def _ask(self) -> None:
        with self._client() as client:
            while not self._stop.wait(1.0):
                answer = client.post(
                    "/api/v1/similarity",
                    files={"file": ("query.jpg", photo_bytes(0))},
                    headers={"Prefer": "wait=20"},
                )
                if answer.status_code != 200:
                    self.unanswered.append(answer.text)


@dataclass(frozen=True, slots=True)
class Rates:
    """Jobs per second that were queued and that ended."""

    queued: float
    ended: float

    @classmethod
    def between(cls, fleet: Fleet, begin: datetime, end: datetime) -> Self:
        def count(column: InstrumentedAttribute[Any]) -> float:
            window = select(func.count()).where(column > begin, column <= end)
            with fleet.catalog.read() as session:
                return (session.scalar(window) or 0) / (end - begin).total_seconds()

        return cls(count(Job.created_at), count(Job.finished_at))

    def __str__(self) -> str:
        return f"{self.queued:.1f} queued and {self.ended:.1f} ended a second"


@contextlib.contextmanager
def frozen(fleet: Fleet) -> Iterator[None]:
    fleet.servers.processes["Redis"].pause()
    try:
        yield
    finally:
        fleet.servers.processes["Redis"].resume()


@contextlib.contextmanager
def killed(fleet: Fleet) -> Iterator[None]:
    fleet.servers.processes["Redis"].kill()
    try:
        yield
    finally:
        fleet.servers.processes["Redis"].start()


@contextlib.contextmanager
def full(fleet: Fleet) -> Iterator[None]:
    fleet.servers.redis.fill()
    try:
        yield
    finally:
        fleet.servers.redis.empty()


@pytest.mark.parametrize(
    ("outage", "seconds"), [(frozen, 7.0), (frozen, 16.0), (killed, 20.0), (full, 10.0)]
)
def test_photos_are_described_and_queries_answered_while_redis_is_away(
    fleet: Fleet,
    outage: Callable[[Fleet], contextlib.AbstractContextManager[None]],
    seconds: float,
) -> None:
    crashed = len(fleet.crashed)
    with Load(fleet, numbers) as load:
        time.sleep(BEFORE_SECONDS)
        begun = datetime.now(UTC)
        with outage(fleet):
            time.sleep(seconds)
            health = httpx2.get(
                f"{fleet.gateway_urls[0]}/api/v1/health",
                headers={"Authorization": f"Bearer {SERVICES_KEY}"},
                timeout=30,
            ).json()
        repaired = datetime.now(UTC)
        time.sleep(2 * RECOVERY_SECONDS)
        ended = datetime.now(UTC)
    recovered = repaired + timedelta(seconds=RECOVERY_SECONDS)
    during = Rates.between(fleet, begun, repaired)
    after = Rates.between(fleet, recovered, ended)
    before = Rates.between(fleet, begun - timedelta(seconds=BEFORE_SECONDS), begun)
    print(f"{outage.__name__} for {seconds:g} s: before {before}, during {during}, after {after}")
    assert fleet.crashed[crashed:] == []
    assert load.unanswered == []
    assert during.ended > 0.5 * during.queued
    assert after.ended > 0.5 * after.queued
    assert health["parts"]["queue"]["status"] == "degraded", health
    assert health["parts"]["extractors"]["status"] == "healthy", health
    wait_until(lambda: not count_unfinished_jobs(fleet.catalog))
    acknowledged.update(load.acknowledged)
    counts = check_invariants(fleet.catalog, fleet.store, acknowledged)
    assert counts.none_found, counts
    with Redis.from_url(fleet.servers.redis.url) as client:
        wait_until(lambda: not any(client.llen(queue) for queue in WakeupQueue))
