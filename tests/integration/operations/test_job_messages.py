"""Jobs as Celery messages on a real Redis, and an extractor in a process of its own."""

from __future__ import annotations

import base64
import json
import threading
import time
from collections.abc import Generator, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from celery import Celery
from redis import Redis
from sqlalchemy import func, select, update

from services.extractor import celery_node
from services.extractor.celery_node import CeleryNode
from services.service_process import start_service_threads
from services.steward.tasks.maintenance import resend_wakeups
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.installation import open_installation_store
from shared.config.settings import Settings
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, celery_messages
from shared.jobs.celery_messages import (
    BROKER_TIMEOUT_SECONDS,
    MAX_QUEUED,
    CeleryJobMessages,
    create_celery_app,
    encode_message,
)
from shared.jobs.transitions import cancel_job
from shared.jobs.wakeups import JobMessage, WakeupQueue, read_job_messages
from shared.storage import FolderStore
from shared.telemetry import celery_config
from tests.support.catalog_rows import add_map, ask, upload
from tests.support.photos import photo_bytes
from tests.support.processes import PLACEWISE, start
from tests.support.server import environment
from tests.support.servers import PostgresServer, RedisServer, start_redis
from tests.support.waiting import wait_until

SECONDS = 60.0


@pytest.fixture
def own_redis() -> Iterator[RedisServer]:
    """A Redis of the test's own, empty, which may be killed."""
    with start_redis(own=True) as server:
        yield server


@pytest.fixture
def app(own_redis: RedisServer) -> Celery:
    return create_celery_app(Settings(redis_url=own_redis.url))


@pytest.fixture
def wakeups(app: Celery, own_redis: RedisServer) -> Iterator[CeleryJobMessages]:
    made = CeleryJobMessages(app, Settings(redis_url=own_redis.url))
    yield made
    made.close()


@pytest.fixture
def client(own_redis: RedisServer) -> Iterator[Redis]:
    with Redis.from_url(own_redis.url) as opened:
        yield opened


def message(number: int = 0, kind: JobKind = JobKind.INDEX) -> JobMessage:
    return JobMessage(new_id(), kind, WakeupQueue.BULK, "harbour", f"{number}.jpg")


def test_celery_reads_a_message_that_names_the_job_its_map_and_its_file(
    wakeups: CeleryJobMessages, app: Celery
) -> None:
    job = message(7, JobKind.REINDEX)
    wakeups.send(job)
    with (
        app.connection_for_read() as connection,
        connection.SimpleQueue(job.queue, no_ack=True) as queue,
    ):
        found = queue.get(timeout=SECONDS)
    assert found.headers["task"] == "placewise.reindex"
    assert found.headers["id"] == str(job.id)
    arguments, named, _ = found.payload
    assert (arguments, named) == ([], {"map": "harbour", "file": "7.jpg"})


def test_flower_is_configured_with_the_queues_of_messages() -> None:
    assert {queue.name for queue in celery_config.task_queues} == set(WakeupQueue)


def test_the_messages_of_claimed_jobs_are_withdrawn_and_those_of_others_stay(
    wakeups: CeleryJobMessages, app: Celery, client: Redis
) -> None:
    jobs = [message(number) for number in range(5)]
    wakeups.send(*jobs)
    wait_until(lambda: client.llen(WakeupQueue.BULK) == 5)
    wakeups.claimed(jobs[1], jobs[4])
    wait_until(lambda: client.llen(WakeupQueue.BULK) == 3)
    left = [encode_message(app, jobs[number]).encode() for number in (3, 2, 0)]
    assert client.lrange(WakeupQueue.BULK, 0, -1) == left


def test_a_queue_holds_few_messages_however_many_are_sent(
    wakeups: CeleryJobMessages, client: Redis
) -> None:
    for _ in range(3):
        wakeups.send(*(message(number) for number in range(MAX_QUEUED // 2)))
        time.sleep(0.1)
    wait_until(lambda: client.llen(WakeupQueue.BULK) == MAX_QUEUED)
    wakeups.send(message())
    wakeups.send(last := JobMessage(new_id(), JobKind.FIT, WakeupQueue.MODEL, "harbour", None))
    wait_until(lambda: client.llen(last.queue) == 1)
    assert client.llen(WakeupQueue.BULK) == MAX_QUEUED


def test_without_redis_a_message_neither_waits_nor_raises_and_the_next_one_arrives(
    wakeups: CeleryJobMessages, client: Redis, own_redis: RedisServer
) -> None:
    assert own_redis.process is not None
    own_redis.process.kill()
    begun = time.monotonic()
    for number in range(100):
        wakeups.send(message(number))
    assert time.monotonic() - begun < BROKER_TIMEOUT_SECONDS
    wait_until(lambda: wakeups.problem is not None)
    own_redis.process.start()
    wait_until(lambda: wakeups.problem is None)
    wakeups.send(message())
    wait_until(lambda: client.llen(WakeupQueue.BULK) > 0)


def test_a_full_redis_takes_events_and_no_messages(
    wakeups: CeleryJobMessages, app: Celery, client: Redis
) -> None:
    client.config_set("maxmemory-policy", "noeviction")
    client.config_set("maxmemory", "1")
    with client.pubsub() as listening:  # type: ignore[no-untyped-call]
        listening.psubscribe("/0.celeryev/*")
        wakeups.send(message())
        wait_until(lambda: wakeups.problem is not None and "maxmemory" in wakeups.problem)
        wait_until(lambda: (heard := listening.get_message()) and heard["type"] == "pmessage")
    client.config_set("maxmemory", "0")
    wait_until(lambda: wakeups.problem is None)


def test_ended_jobs_are_reported_with_their_runtime_or_their_error(
    wakeups: CeleryJobMessages, client: Redis
) -> None:
    begun = datetime.now(UTC)
    times = {"started_at": begun, "finished_at": begun + timedelta(seconds=2)}
    error = {"code": "undecodable_photo", "detail": "It is cut off."}
    found: dict[str, dict[str, Any]] = {}
    with client.pubsub() as listening:  # type: ignore[no-untyped-call]
        listening.psubscribe("/0.celeryev/*")
        wait_until(listening.get_message)
        for state, fields in ((JobState.SUCCEEDED, times), (JobState.FAILED, {"error": error})):
            wakeups.report(Job(id=new_id(), kind=JobKind.INDEX, state=state, **fields))

        def both() -> bool:
            heard = listening.get_message()
            for event in json.loads(_event_text(heard["data"]) or b"[]") if heard else []:
                found[event["type"]] = event
            return len(found) == 2

        wait_until(both)
    assert found["task-succeeded"]["runtime"] == 2.0
    assert found["task-failed"]["exception"] == "undecodable_photo: It is cut off."


def test_closing_in_the_middle_of_a_burst_takes_no_time(
    wakeups: CeleryJobMessages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(celery_messages, "DEBOUNCE_SECONDS", 0.5)
    wakeups.send(message())
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


def test_a_thread_that_redis_does_not_answer_is_stuck_unless_redis_answers_nobody(
    wakeups: CeleryJobMessages, app: Celery, own_redis: RedisServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(celery_node, "STUCK_SECONDS", 3.0)
    settings = Settings(redis_url=own_redis.url)
    node = CeleryNode(app, settings, "extractor-1@here", wakeups, dict, list)
    hang, stop = threading.Event(), threading.Event()
    receive = node._receive_messages

    def receive_until_it_hangs() -> Generator[None]:
        for _ in receive():
            yield
            hang.wait()

    monkeypatch.setattr(node, "_receive_messages", receive_until_it_hangs)
    threads = start_service_threads(node.threads(), stop)
    assert own_redis.process is not None
    own_redis.process.kill()
    wait_until(lambda: wakeups.problem is not None)
    time.sleep(4.0)
    assert node.stuck_thread() is None, "nobody gets an answer"
    own_redis.process.start()
    wait_until(lambda: node.stuck_thread() is not None)
    assert node.stuck_thread() == "messages", "the other thread connects again"
    stop.set()
    hang.set()
    for thread in threads:
        thread.join()


def test_a_busy_extractor_takes_the_messages_of_queries_and_leaves_those_of_photos(
    wakeups: CeleryJobMessages, app: Celery, own_redis: RedisServer, client: Redis
) -> None:
    stop, arrived = threading.Event(), threading.Event()
    settings = Settings(redis_url=own_redis.url)
    node = CeleryNode(app, settings, "extractor-1@here", wakeups, dict, arrived.set)
    threads = start_service_threads(node.threads(), stop)
    wakeups.send(message(), replace(message(), queue=WakeupQueue.QUERY))
    assert arrived.wait(SECONDS)
    assert client.llen(WakeupQueue.QUERY) == 0
    assert client.llen(WakeupQueue.BULK) == 1
    assert node.wait(SECONDS), "the query's message ends a pause, too"
    assert node.wait(SECONDS), "an idle extractor takes the photo's"
    stop.set()
    for thread in threads:
        thread.join()


MALFORMED = [
    b"",
    b"\xff\xfe\x00",
    b"null",
    b"[]",
    b"{}",
    b'{"body": "e30=", "headers": {}, "properties": {}}',
    b'{"properties": {"delivery_tag": "no id"}}',
    b'{"body": "!", "headers": {"id": 7}, "properties": {"delivery_tag": 7}}',
    b"[" * 10_000,
    b"x" * 1_000_000,
]


def test_an_extractor_runs_queued_jobs_whatever_happens_to_the_messages(
    tmp_path: Path,
    catalog_on_postgres: Catalog,
    map_id: UUID,
    wakeups: CeleryJobMessages,
    client: Redis,
    extractor: Extractor,
) -> None:
    store = FolderStore(tmp_path / "home" / "objects", exclusive=False)
    photos = iter(range(1000))

    def put(count: int) -> None:
        for _ in range(count):
            upload(catalog_on_postgres, store, map_id, photo_bytes(next(photos)))

    put(20)  # before the extractor came, or while it starts: no message is sent
    wait_until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 20})

    for text in MALFORMED:
        for queue in WakeupQueue:
            client.lpush(queue, text)
        for channel in ("/0.celery.pidbox", "/0.celeryev/task.multi"):
            client.publish(channel, text)
    put(20)
    ask(catalog_on_postgres, store, map_id, photo_bytes(3))
    resend_wakeups(catalog_on_postgres, wakeups)  # the steward's task
    resend_wakeups(catalog_on_postgres, wakeups)  # two of one are harmless
    wait_until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 41})
    resend_wakeups(catalog_on_postgres, wakeups)
    wait_until(lambda: not client.keys("placewise*"))

    put(5)
    client.flushall()
    wait_until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 46})

    extractor.process.terminate()
    assert extractor.process.wait(timeout=30) == 0
    put(5)
    extractor.start()
    wait_until(lambda: done(catalog_on_postgres) == {JobState.SUCCEEDED: 51})


def test_the_steward_sends_lost_messages_and_withdraws_those_of_jobs_that_wait_no_longer(
    tmp_path: Path,
    catalog_on_postgres: Catalog,
    map_id: UUID,
    wakeups: CeleryJobMessages,
    client: Redis,
) -> None:
    store = FolderStore(tmp_path / "objects", exclusive=False)
    for number in range(4):
        upload(catalog_on_postgres, store, map_id, photo_bytes(number))
    assert resend_wakeups(catalog_on_postgres, wakeups) == 0, "they may be under way"
    with catalog_on_postgres.write() as session:
        session.execute(update(Job).values(created_at=db_now_plus(-10)))
        ids = session.scalars(select(Job.id)).all()
        twice = read_job_messages(session, ids[:1])
    assert resend_wakeups(catalog_on_postgres, wakeups) == 4
    wait_until(lambda: client.llen(WakeupQueue.BULK) == 4)
    wakeups.send(message(), *twice)  # the first of a job that was deleted since
    wait_until(lambda: client.llen(WakeupQueue.BULK) == 6)
    with catalog_on_postgres.write() as session:
        cancelled = session.scalars(select(Job).order_by(Job.id)).first()
        assert cancelled is not None
        cancel_job(cancelled)
    with client.pubsub() as listening:  # type: ignore[no-untyped-call]
        listening.psubscribe("/0.celeryev/*")
        assert resend_wakeups(catalog_on_postgres, wakeups) == 0
        assert client.llen(WakeupQueue.BULK) == 3

        def revoked() -> bool:
            heard = listening.get_message()
            return bool(heard and b"task-revoked" in _event_text(heard["data"]))

        wait_until(revoked)


def _event_text(data: Any) -> bytes:
    return base64.b64decode(json.loads(data)["body"]) if isinstance(data, bytes) else b""
