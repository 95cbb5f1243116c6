"""Gateways that are killed while they answer: each call, repeated under its key, is done once."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import UUID

import httpx2
import pytest
from sqlalchemy import select

from shared.catalog.session import Catalog
from shared.ids import new_id
from shared.jobs import Job, JobKind
from tests.e2e.test_separate_services import Deployment
from tests.support.photos import near_copy
from tests.support.servers import PostgresServer, RedisServer

ROUNDS = 3
CALLS = 24  # in each round
SECONDS = 90.0  # a key that a killed gateway had claimed comes back when its lease has expired


@pytest.fixture
def deployment(
    tmp_path: Path, postgres: PostgresServer, redis: RedisServer
) -> Iterator[Deployment]:
    made = Deployment(tmp_path, postgres.new_database(), redis.url)
    made.settings["search_urls"] = "http://127.0.0.1:9"  # nobody searches here
    try:
        yield made
    finally:
        made.close()


def ask(addresses: list[str], photo: bytes) -> UUID:
    """A query photo, whose every effect is a job of its own: its job, by whoever answers first."""
    key, deadline = {"Idempotency-Key": str(new_id())}, time.monotonic() + SECONDS
    files = {"file": ("query.jpg", photo)}
    while True:
        for address in addresses:
            assert time.monotonic() < deadline, "the call was never answered"
            try:
                answer = httpx2.post(
                    f"{address}/api/v1/similarity", files=files, headers=key, timeout=30
                )
            except httpx2.TransportError:
                continue  # killed, before or after it was done: who asks can't know
            if answer.status_code == 202:
                return UUID(answer.json()["job_id"])
            assert answer.json()["code"] == "idempotency_key_in_use", answer.text
            time.sleep(float(answer.headers["retry-after"]))


def test_calls_to_gateways_that_are_killed_have_one_effect_each(deployment: Deployment) -> None:
    chance = random.Random(7)
    deployment.start("gateway")
    lasting = deployment.address("gateway", 0)
    answered: list[UUID] = []
    for number in range(1, ROUNDS + 1):
        doomed = deployment.start("gateway")
        addresses = [deployment.address("gateway", number), lasting]
        while True:
            try:
                httpx2.get(f"{addresses[0]}/livez").raise_for_status()
                break
            except httpx2.TransportError:
                time.sleep(0.05)
        with ThreadPoolExecutor(6) as pool:
            calls = [
                pool.submit(ask, addresses, near_copy(1000 * number + photo))
                for photo in range(CALLS)
            ]
            time.sleep(chance.uniform(0.02, 0.25))
            doomed.kill()
            answered += [call.result() for call in calls]
    catalog = Catalog(str(deployment.settings["database_url"]))
    with catalog.read() as session:
        made = session.scalars(select(Job.id).where(Job.kind == JobKind.DESCRIBE)).all()
    catalog.close()
    assert len(answered) == ROUNDS * CALLS
    assert sorted(made) == sorted(answered)
