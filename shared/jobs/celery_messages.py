"""Jobs as Celery messages and events on Redis, sent from a thread.

A message is a Celery task (protocol 2) whose id is the job's; the queue's length is the number of
waiting jobs. A worker withdraws the messages of the jobs that it claims, so the same job always
gets the same bytes. Events tell Flower what becomes of each job, whichever batch runs it.

Celery's own consumer is not used (decision 17). Nothing waits
for Redis: while it is unreachable, messages are dropped, and the steward sends them again
(`resend`); events are kept, up to MAX_PENDING.
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import logging
import socket
import threading
import time
from collections import defaultdict, deque
from typing import Any
from uuid import UUID

from celery import Celery
from celery.events.event import EVENT_EXCHANGE_NAME
from kombu.exceptions import KombuError, OperationalError
from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy import select

from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import claimable_condition
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.jobs import Job, JobState
from shared.jobs.wakeups import JobMessage, WakeupQueue, read_job_messages

log = logging.getLogger(__name__)

BROKER_TIMEOUT_SECONDS = 5
BROKER_ERRORS = (OperationalError, KombuError, RedisError, OSError)


def create_celery_app(settings: Settings) -> Celery:
    """Create the Celery application: the broker, and JSON as the only format.

    Raises:
        Misconfigured: REDIS_URL is not set.
    """
    if settings.redis_url is None:
        raise Misconfigured(
            "redis_missing",
            "REDIS_URL is not set: separate services wake each other through Redis. Set it, for "
            "example redis://:PASSWORD@redis:6379/0, or run everything in one process: placewise "
            "serve.",
        )
    app = Celery("placewise", broker=settings.redis_url.get_secret_value(), set_as_current=False)
    app.conf.update(
        accept_content=["json"],
        broker_connection_timeout=BROKER_TIMEOUT_SECONDS,
        broker_transport_options={
            "socket_timeout": BROKER_TIMEOUT_SECONDS,
            "socket_connect_timeout": BROKER_TIMEOUT_SECONDS,
            "socket_keepalive": True,
            "retry_on_timeout": False,
            "max_retries": 1,  # each thread has a loop of its own that connects again
            "interval_start": 0,
        },
    )
    return app


def open_redis(settings: Settings) -> Redis:
    """Return a client of REDIS_URL whose calls raise after BROKER_TIMEOUT_SECONDS."""
    assert settings.redis_url is not None, "create_celery_app has checked it"
    return Redis.from_url(
        settings.redis_url.get_secret_value(),
        socket_timeout=BROKER_TIMEOUT_SECONDS,
        socket_connect_timeout=BROKER_TIMEOUT_SECONDS,
    )


MAX_QUEUED = 5000  # messages of one queue; the job table holds the others until there is room
MAX_PENDING = 20_000  # events, and messages, that this process keeps for Redis
EVENTS_PER_MESSAGE = 500
# A burst of uploads is sent together.
DEBOUNCE_SECONDS = 0.01
PING_SECONDS = 2.0  # without anything to send
RETRY_SECONDS = 1.0
SETTLED_SECONDS = 2.0  # that a message may take from the commit to Redis before it counts as lost
WARNING_INTERVAL_SECONDS = 60.0  # between two log lines about an unreachable Redis


class CeleryJobMessages:
    """Sends messages about jobs from a thread, which `close` ends.

    `worker` is the name of the Celery worker that this process is, in whose name it sends events.
    """

    def __init__(self, app: Celery, settings: Settings, worker: str | None = None) -> None:
        self._app = app
        self._worker = worker or f"placewise@{socket.gethostname()}"
        self._redis = open_redis(settings)
        database = self._redis.get_connection_kwargs()["db"]
        self._event_channel = f"/{database}.{EVENT_EXCHANGE_NAME}/task.multi"
        self._lengths = dict.fromkeys(WakeupQueue, 0)
        self._messages: deque[JobMessage] = deque(maxlen=MAX_PENDING)
        self._withdrawn: deque[JobMessage] = deque(maxlen=MAX_PENDING)
        self._events: deque[dict[str, Any]] = deque(maxlen=MAX_PENDING)
        self._any_pending = threading.Event()
        self._stop = threading.Event()
        self._next_warning = 0.0
        self.problem: str | None = None
        self.answers_since: float | None = None
        """Since when Redis takes what is sent (monotonic)."""
        self.active: set[UUID] = set()
        """The jobs that this worker has claimed."""
        self._sender = threading.Thread(target=self._run, name="wakeups", daemon=True)
        self._sender.start()

    def send(self, *jobs: JobMessage) -> None:
        self._messages.extend(jobs)
        for job in jobs:
            self.send_event("task-sent", **_describe(job), queue=job.queue)

    def claimed(self, *jobs: JobMessage) -> None:
        self._withdrawn.extend(jobs)
        self.active.update(job.id for job in jobs)
        for job in jobs:
            self.send_event("task-received", **_describe(job))

    def started(self, *jobs: Job) -> None:
        for job in jobs:
            self.send_event("task-started", uuid=str(job.id))

    def report(self, *jobs: Job) -> None:
        for job in jobs:
            self.active.discard(job.id)
            if job.lease_token is not None:
                continue  # another worker has taken it over
            worker = {"hostname": job.worker} if job.worker else {}
            kind, fields = _state_event(job)
            self.send_event(kind, uuid=str(job.id), **fields, **worker)

    def send_event(self, kind: str, **fields: Any) -> None:
        """Send a Celery event, by default in the name of this process."""
        event = {"hostname": self._worker, "timestamp": time.time(), "utcoffset": 0}
        self._events.append({"type": kind, **event, **fields})
        self._any_pending.set()

    def resend(self, catalog: Catalog) -> int:
        if self.problem is not None:
            return 0
        try:
            messages = [(q, text) for q in WakeupQueue for text in self._redis.lrange(q, 0, -1)]
        except BROKER_ERRORS:
            return 0  # the thread logs it
        queued: dict[UUID, list[tuple[WakeupQueue, bytes | str]]] = defaultdict(list)
        malformed: list[tuple[WakeupQueue, bytes | str]] = []
        for message in messages:
            job_id = _job_id(message[1])
            (malformed if job_id is None else queued[job_id]).append(message)
        with catalog.read() as session:
            claimable = select(Job.id).where(claimable_condition())
            settled = claimable.where(Job.created_at < db_now_plus(-SETTLED_SECONDS))
            waiting = session.scalars(
                settled.order_by(Job.priority.desc(), Job.id).limit(MAX_QUEUED)
            ).all()
            missing = read_job_messages(session, [id_ for id_ in waiting if id_ not in queued])
            others = queued.keys() - set(waiting)
            others -= set(session.scalars(claimable.where(Job.id.in_(others)))) if others else set()
            cancelled = session.scalars(
                select(Job).where(Job.id.in_(others), Job.state == JobState.CANCELLED)
            ).all()
        if malformed:
            log.warning("%d malformed messages on Redis are dropped", len(malformed))
        with contextlib.suppress(*BROKER_ERRORS), self._redis.pipeline(transaction=False) as pipe:
            outdated = [
                copy
                for id_, copies in queued.items()
                for copy in (copies if id_ in others else copies[1:])
            ]
            for queue, text in [*malformed, *outdated]:
                pipe.execute_command("LREM", queue, 1, text)  # type: ignore[no-untyped-call]
            pipe.execute()
        self.report(*cancelled)
        self.send(*missing)
        return len(missing)

    def close(self) -> None:
        self._stop.set()
        self._any_pending.set()
        self._sender.join(timeout=3 * BROKER_TIMEOUT_SECONDS)
        self._redis.close()

    def _run(self) -> None:
        stopping = False
        while not stopping:
            self._any_pending.wait(PING_SECONDS)
            stopping = self._stop.wait(DEBOUNCE_SECONDS)  # what is pending is still sent
            self._any_pending.clear()
            try:
                self._send_pending()
                self.problem, self.answers_since = None, self.answers_since or time.monotonic()
            except BROKER_ERRORS as error:
                self.problem, self.answers_since = str(error), None
                if time.monotonic() > self._next_warning:
                    self._next_warning = time.monotonic() + WARNING_INTERVAL_SECONDS
                    log.warning("Redis takes no messages; they are dropped: %s", error)
                self._stop.wait(RETRY_SECONDS)

    def _send_pending(self) -> None:
        """Send what is pending; messages that Redis does not take are dropped, events are kept."""
        withdrawn, messages = _take_all(self._withdrawn), _take_all(self._messages)
        events = list(itertools.islice(self._events, EVENTS_PER_MESSAGE))
        with self._redis.pipeline(transaction=False) as pipe:
            if events:  # also a Redis that is full publishes them
                route = {"exchange": EVENT_EXCHANGE_NAME, "routing_key": "task.multi"}
                headers, tag = {"hostname": events[0]["hostname"]}, events[0].get("uuid", "")
                pipe.publish(self._event_channel, _encode(events, headers, tag, route))
            for job in withdrawn:
                pipe.lrem(job.queue, -1, encode_message(self._app, job))
            for job in messages:
                self._lengths[job.queue] += 1
                if self._lengths[job.queue] <= MAX_QUEUED:
                    pipe.lpush(job.queue, encode_message(self._app, job))
            for queue in WakeupQueue:
                pipe.llen(queue)
            replies = pipe.execute(raise_on_error=False)
        if events and not isinstance(replies[0], Exception):
            for _ in events:
                self._events.popleft()
        if len(self._events):
            self._any_pending.set()
        for reply in replies:
            if isinstance(reply, Exception):
                raise reply
        self._lengths = dict(zip(WakeupQueue, replies[-len(WakeupQueue) :], strict=True))


def _take_all(pending: deque[JobMessage]) -> list[JobMessage]:
    return [pending.popleft() for _ in range(len(pending))]


def encode_message(app: Celery, job: JobMessage) -> str:
    """Return the Celery message of a job as Redis holds it: the same text for the same job."""
    task = app.amqp.as_task_v2(
        str(job.id), job.task, args=(), kwargs=_arguments(job), origin="placewise"
    )
    route = {"exchange": "", "routing_key": job.queue}
    return _encode(task.body, task.headers, str(job.id), route, **task.properties)


def _encode(
    body: Any, headers: dict[str, Any], tag: str, route: dict[str, str], **properties: Any
) -> str:
    """Return a message of kombu's Redis transport."""
    message = {
        "body": base64.b64encode(json.dumps(body).encode()).decode(),
        "content-encoding": "utf-8",
        "content-type": "application/json",
        "headers": headers,
        "properties": {
            **properties,
            "delivery_mode": 2,
            "delivery_info": route,
            "priority": 0,
            "body_encoding": "base64",
            "delivery_tag": tag,
        },
    }
    return json.dumps(message)


def _job_id(message: bytes | str) -> UUID | None:
    """Return the job of a message; None if this is not the message of a job."""
    try:
        return UUID(json.loads(message)["properties"]["delivery_tag"])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _arguments(job: JobMessage) -> dict[str, str]:
    return {"map": job.map} | ({"file": job.file} if job.file else {})


def _describe(job: JobMessage) -> dict[str, str]:
    return {
        "uuid": str(job.id),
        "name": job.task,
        "args": "()",
        "kwargs": repr(_arguments(job)),
        "root_id": str(job.id),
    }


def _state_event(job: Job) -> tuple[str, dict[str, Any]]:
    """Return the type and fields of the event that says in which state the job is."""
    reason = f"waits for {job.waiting_for}" if job.waiting_for else "returned to the queue"
    if job.error:
        reason = f"{job.error['code']}: {job.error['detail']}"
    match job.state:
        case JobState.SUCCEEDED:
            assert job.started_at is not None
            assert job.finished_at is not None
            runtime = (job.finished_at - job.started_at).total_seconds()
            return "task-succeeded", {"runtime": runtime, "result": json.dumps(job.result)}
        case JobState.FAILED:
            return "task-failed", {"exception": reason, "traceback": None}
        case JobState.CANCELLED:
            return "task-revoked", {"terminated": False, "signum": None, "expired": False}
        case _:
            return "task-retried", {"exception": reason, "traceback": None}
