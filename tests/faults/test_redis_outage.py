"""Redis that stands still, is killed or full: photos are described, queries answered meanwhile.

`make test-chaos` has the longer outages (90 s, two minutes).
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any
from uuid import UUID

import httpx2
import pytest
from redis import Redis

from shared.jobs.wakeups import WakeupQueue
from tests.support.fleet import Fleet, Servers, open_fleet
from tests.support.invariants import count_unfinished_jobs, find_violations
from tests.support.photos import photo_bytes
from tests.support.server import SERVICES_KEY
from tests.support.waiting import wait_until

PHOTOS = 12  # described during the outage and after it

pytestmark = [pytest.mark.servers, pytest.mark.timeout(900)]
numbers = itertools.count()


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    with open_fleet(
        executed=False,
        extractor="test-slow-avg:milliseconds=5,width=256",
        lease_seconds=5.0,
        batch_photos=8,
    ) as opened:
        opened.start()
        yield opened


@pytest.fixture(scope="module")
def client(fleet: Fleet) -> Iterator[httpx2.Client]:
    headers = {"Authorization": f"Bearer {SERVICES_KEY}"}
    url = f"{fleet.gateway_urls[0]}/api/v1"
    with httpx2.Client(base_url=url, headers=headers, timeout=60) as opened:
        yield opened


def describe_photos(fleet: Fleet, client: httpx2.Client) -> dict[str, UUID]:
    """Upload photos, wait until all are described, and find the last one; their hashes and ids."""
    uploaded = {}
    for data in map(photo_bytes, itertools.islice(numbers, PHOTOS)):
        answer = client.post("/upload", files={"file": ("photo.jpg", data)})
        assert answer.status_code == 202, answer.text
        uploaded[hashlib.sha256(data).hexdigest()] = UUID(answer.json()["file_id"])
    wait_until(lambda: not count_unfinished_jobs(fleet.catalog))
    found = client.post(
        "/similarity", files={"file": ("query.jpg", data)}, headers={"Prefer": "wait=30"}
    )
    assert found.status_code == 200, found.text
    assert UUID(found.json()["similar_images"][0]["image_id"]) == list(uploaded.values())[-1]
    return uploaded


@pytest.mark.parametrize(
    ("begin", "end"),
    [
        pytest.param(
            lambda s: s.processes["Redis"].pause(),
            lambda s: s.processes["Redis"].resume(),
            id="stands still",
        ),
        pytest.param(
            lambda s: s.processes["Redis"].kill(),
            lambda s: s.processes["Redis"].start(),
            id="killed",
        ),
        pytest.param(lambda s: s.redis.fill(), lambda s: s.redis.empty(), id="full"),
    ],
)
def test_photos_are_described_and_queries_answered_while_redis_is_away(
    fleet: Fleet,
    client: httpx2.Client,
    begin: Callable[[Servers], object],
    end: Callable[[Servers], object],
) -> None:
    def parts() -> Any:
        return client.get("/health").json()["parts"]

    acknowledged = describe_photos(fleet, client)
    begin(fleet.servers)
    try:
        acknowledged |= describe_photos(fleet, client)
        wait_until(lambda: parts()["queue"]["status"] == "degraded")
        assert parts()["extractors"]["status"] == "healthy"
    finally:
        end(fleet.servers)
    acknowledged |= describe_photos(fleet, client)
    assert not fleet.crashed
    assert not find_violations(fleet.catalog, fleet.store, acknowledged)
    with Redis.from_url(fleet.servers.redis.url) as redis:
        wait_until(lambda: not any(redis.llen(queue) for queue in WakeupQueue))
