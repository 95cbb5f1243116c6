"""Hints over Celery on a real Redis, and an extractor in a process of its own that they wake."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID

import pytest
from redis import Redis
from sqlalchemy import func, select

from services.steward.tasks.maintenance import resend_wakeups
from shared.catalog.database.session import Catalog
from shared.catalog.installation import open_installation_store
from shared.config.settings import Settings
from shared.jobs import Job, JobState, celery_wakeups
from shared.jobs.celery_wakeups import (
    BROKER_TIMEOUT_SECONDS,
    DRAIN_TASK,
    MAX_PENDING_WAKEUPS,
    CeleryWakeups,
    create_celery_app,
)
from shared.jobs.wakeups import WakeupQueue
from shared.storage import FolderStore
from tests.support.catalog_rows import add_map, ask, upload
from tests.support.photos import photo_bytes
from tests.support.processes import PLACEWISE, start
from tests.support.server import environment
from tests.support.servers import PostgresServer, RedisServer, start_redis

SECONDS = 60.0


@pytest.fixture
def own_redis() -> Iterator[RedisServer]:
    """A Redis of the test's own, empty, which may be killed."""
    with start_redis(own=True) as server:
        yield server


@pytest.fixture
def wakeups(own_redis: RedisServer) -> Iterator[CeleryWakeups]:
    settings = Settings(redis_url=own_redis.url)
    made = CeleryWakeups(create_celery_app(settings), settings)
    yield made
    made.close()


def waiting(server: RedisServer) -> dict[WakeupQueue, list[bytes]]:
    with Redis.from_url(server.url) as client:
        return {lane: list(client.lrange(lane, 0, -1)) for lane in WakeupQueue}


def until(condition) -> None:  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < deadline, "it did not come to that"
        time.sleep(0.05)


def test_a_wakeup_is_json_that_names_no_job(wakeups: CeleryWakeups, own_redis: RedisServer) -> None:
    wakeups.send(WakeupQueue.QUERY)
    until(lambda: waiting(own_redis)[WakeupQueue.QUERY])
    found = waiting(own_redis)
    assert (len(found[WakeupQueue.QUERY]), len(found[WakeupQueue.BULK])) == (1, 0)
    message = json.loads(found[WakeupQueue.QUERY][0])
    assert message["content-type"] == "application/json"
    assert message["headers"]["task"] == DRAIN_TASK
    arguments, named, _ = json.loads(base64.b64decode(message["body"]))
    assert (arguments, named) == ([], {})


def test_a_queue_holds_few_wakeups_however_many_are_sent(
    wakeups: CeleryWakeups, own_redis: RedisServer
) -> None:
    for _ in range(3 * MAX_PENDING_WAKEUPS):
        wakeups.send()
        time.sleep(0.02)
    until(lambda: len(waiting(own_redis)[WakeupQueue.BULK]) >= MAX_PENDING_WAKEUPS)
    time.sleep(0.2)
    assert len(waiting(own_redis)[WakeupQueue.BULK]) == MAX_PENDING_WAKEUPS


def test_without_redis_a_wakeup_neither_waits_nor_raises_and_the_next_one_arrives(
    wakeups: CeleryWakeups, own_redis: RedisServer
) -> None:
    assert own_redis.process is not None
    own_redis.process.kill()
    begun = time.monotonic()
    for _ in range(100):
        wakeups.send()
    assert time.monotonic() - begun < BROKER_TIMEOUT_SECONDS
    own_redis.process.start()

    def arrived() -> bool:
        wakeups.send()
        return bool(waiting(own_redis)[WakeupQueue.BULK])

    until(arrived)


def test_closing_in_the_middle_of_a_burst_takes_no_time(
    wakeups: CeleryWakeups, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(celery_wakeups, "DEBOUNCE_SECONDS", 0.5)
    wakeups.send()
    time.sleep(0.2)
    begun = time.monotonic()
    wakeups.close()
    assert time.monotonic() - begun < BROKER_TIMEOUT_SECONDS


class Extractor:
    """`placewise extractor` on a PostgreSQL, a Redis and a folder."""

    def __init__(self, home: Path, catalog: Catalog, redis: RedisServer) -> None:
        self._home = home
        url = catalog.url.render_as_string(hide_password=False)
        self._environment = environment(home, database_url=url, redis_url=redis.url)
        self.start()

    def start(self) -> None:
        with (self._home.parent / "extractor.log").open("ab") as log:
            self.process = start(
                [PLACEWISE, "extractor"],
                env=self._environment,
                cwd=self._home.parent,
                stdout=log,
                stderr=log,
            )


@pytest.fixture
def catalog_on_postgres(postgres: PostgresServer, migrated_postgres: str) -> Iterator[Catalog]:
    opened = Catalog(postgres.new_database(migrated_postgres))
    yield opened
    opened.close()


@pytest.fixture
def map_id(catalog_on_postgres: Catalog) -> UUID:
    with catalog_on_postgres.write() as session:
        return add_map(session, "default", "test-tiny-avg").id


@pytest.fixture
def extractor(
    tmp_path: Path, catalog_on_postgres: Catalog, own_redis: RedisServer, map_id: UUID
) -> Iterator[Extractor]:
    # The folder belongs to the catalog before photos are stored: until their rows are committed, it
    # would look like another catalog's.
    home = tmp_path / "home"
    open_installation_store(catalog_on_postgres, Settings(placewise_home=home), exclusive=False)
    started = Extractor(home, catalog_on_postgres, own_redis)
    yield started
    started.process.kill()
    started.process.wait()


def done(catalog: Catalog) -> dict[str, int]:
    with catalog.read() as session:
        found = session.execute(select(Job.state, func.count()).group_by(Job.state))
        return {str(state): count for state, count in found}


def test_an_extractor_runs_queued_jobs_whatever_happens_to_the_wakeups(
    tmp_path: Path,
    catalog_on_postgres: Catalog,
    map_id: UUID,
    wakeups: CeleryWakeups,
    own_redis: RedisServer,
    extractor: Extractor,
) -> None:
    store = FolderStore(tmp_path / "home" / "objects", exclusive=False)
    photos = iter(range(1000))

    def put(count: int) -> None:
        for _ in range(count):
            upload(catalog_on_postgres, store, map_id, photo_bytes(next(photos)))

    put(20)  # before the extractor came, or while it starts: no hint is sent
    until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 20})

    put(20)
    ask(catalog_on_postgres, store, map_id, photo_bytes(3))
    for lane in WakeupQueue:
        wakeups.send(lane)
        wakeups.send(lane)  # two of one are harmless
    until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 41})

    put(5)
    with Redis.from_url(own_redis.url) as client:
        client.flushall()
    resend_wakeups(catalog_on_postgres, wakeups)  # the steward's task
    until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 46})

    extractor.process.terminate()
    assert extractor.process.wait(timeout=30) == 0
    put(5)
    extractor.start()
    until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 51})
