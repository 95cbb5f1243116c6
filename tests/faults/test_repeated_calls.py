"""A gateway that is killed before it answers: each call, repeated under its key, is done once."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import UUID

import httpx2
import pytest
from sqlalchemy import select

from shared.catalog.database.session import Catalog
from shared.ids import new_id
from shared.jobs import Job, JobKind
from tests.e2e.test_separate_services import Deployment, until
from tests.support.photos import near_copy
from tests.support.server import SERVICES_KEY
from tests.support.servers import PostgresServer, RedisServer

CALLS = 12
COMMITTED = 8  # of the calls, when their gateway is killed
SECONDS = 90.0  # a key that a killed gateway had claimed comes back when its lease has expired


@pytest.fixture
def deployment(
    tmp_path: Path, postgres: PostgresServer, redis: RedisServer
) -> Iterator[Deployment]:
    made = Deployment(tmp_path, postgres.new_database(), redis.url)
    made.settings["search_urls"] = "http://127.0.0.1:9"  # nobody searches here
    try:
        made.migrate()
        yield made
    finally:
        made.close()


def ask(addresses: list[str], photo: bytes) -> UUID:
    """A query photo, whose every effect is a job of its own: its job, by whoever answers first.

    The first gateway commits at once, and answers much later: nobody describes photos here.
    """
    deadline = time.monotonic() + SECONDS
    files = {"file": ("query.jpg", photo)}
    headers = {
        "Authorization": f"Bearer {SERVICES_KEY}",
        "Idempotency-Key": str(new_id()),
        "Prefer": "wait=60",
    }
    while True:
        for address in addresses:
            assert time.monotonic() < deadline, "the call was never answered"
            try:
                answer = httpx2.post(
                    f"{address}/api/v1/similarity", files=files, headers=headers, timeout=90
                )
            except httpx2.TransportError:
                headers.pop("Prefer", None)
                continue  # killed, before or after it was done: who asks can't know
            if answer.status_code == 202:
                return UUID(answer.json()["job_id"])
            assert answer.json()["code"] == "idempotency_key_in_use", answer.text
            time.sleep(float(answer.headers["retry-after"]))


def test_calls_to_a_gateway_that_is_killed_have_one_effect_each(deployment: Deployment) -> None:
    deployment.start("gateway")
    doomed = deployment.start("gateway")
    addresses = [deployment.address("gateway", number) for number in (1, 0)]
    for address in addresses:
        until(lambda address=address: httpx2.get(f"{address}/livez").is_success)
    catalog = Catalog(str(deployment.settings["database_url"]))

    def made() -> list[UUID]:
        with catalog.read() as session:
            return list(session.scalars(select(Job.id).where(Job.kind == JobKind.DESCRIBE)))

    with ThreadPoolExecutor(CALLS) as pool:
        calls = [pool.submit(ask, addresses, near_copy(number)) for number in range(CALLS)]
        until(lambda: len(made()) >= COMMITTED)
        committed = made()
        doomed.kill()
        answered = [call.result() for call in calls]
    assert set(committed) <= set(answered), "what was done before the kill is what is answered"
    assert sorted(made()) == sorted(answered)
    catalog.close()
