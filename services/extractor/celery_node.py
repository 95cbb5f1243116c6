"""An extractor as Celery's tools see it: a worker that receives messages and answers `inspect`.

Three threads, each of which connects to Redis again after an error. None runs jobs: those are
claimed from the job table, with messages or without (decision 17).
"""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import threading
import time
from collections.abc import Callable, Generator, Mapping
from importlib.metadata import version
from typing import Any

from celery import Celery
from celery.utils.sysinfo import load_average
from kombu.connection import Connection

from shared.catalog.jobs import EXTRACTOR_JOBS
from shared.config.settings import Settings
from shared.jobs.celery_messages import BROKER_ERRORS, RETRY_SECONDS, CeleryJobMessages, open_redis
from shared.jobs.wakeups import WakeupQueue, task_name

log = logging.getLogger(__name__)

HEARTBEAT_SECONDS = 2.0  # as often as Celery's
POP_SECONDS = 1  # that a look for messages blocks
# A thread that Redis has not answered for so long, although it answers others, is stuck.
STUCK_SECONDS = 30.0


class CeleryNode:
    """The Celery worker of this process, called `name`.

    `read_state` returns device and models, as the process registers them; `on_query` is called when
    the message of a query arrives.
    """

    def __init__(
        self,
        app: Celery,
        settings: Settings,
        name: str,
        wakeups: CeleryJobMessages,
        read_state: Callable[[], Mapping[str, Any]],
        on_query: Callable[[], object],
    ) -> None:
        self._app = app
        self._settings = settings
        self._name = name
        self._wakeups = wakeups
        self._read_state, self._on_query = read_state, on_query
        self._started = time.monotonic()
        self._next_heartbeat = 0.0
        self._idle = threading.Event()
        self._arrived = threading.Event()
        self._answered_at = dict.fromkeys(self.threads(), time.monotonic())

    def threads(self) -> dict[str, Callable[[threading.Event], None]]:
        """Return the functions of the threads by name; each runs until its event is set."""
        return {
            "messages": lambda stop: self._run("messages", self._receive_messages, stop),
            "queries": lambda stop: self._run("queries", self._receive_queries, stop),
            "remote control": lambda stop: self._run("remote control", self._serve_control, stop),
        }

    def wait(self, seconds: float) -> bool:
        """Block until a message arrives or the timeout expires; True when one arrived.

        Those of photos are taken only meanwhile: in Redis are the jobs that wait for a worker.
        """
        self._idle.set()
        arrived = self._arrived.wait(seconds)
        self._idle.clear()
        self._arrived.clear()
        return arrived

    def stuck_thread(self) -> str | None:
        """Return the name of a thread that Redis does not answer, although it answers others."""
        since = self._wakeups.answers_since
        for name, answered_at in self._answered_at.items():
            if since and time.monotonic() - max(since, answered_at) > STUCK_SECONDS:
                return name
        return None

    def _run(self, name: str, serve: Callable[[], Generator[None]], stop: threading.Event) -> None:
        """Connect and serve until `stop` is set; each step of `serve` ends within seconds."""
        while not stop.is_set():
            try:
                with contextlib.closing(serve()) as steps:
                    for _ in steps:
                        self._answered_at[name] = time.monotonic()
                        if stop.is_set():
                            return
            except BROKER_ERRORS as error:
                log.info("%s: connecting to Redis again: %s", name, error)
            except Exception as error:  # whatever kombu raises for what it can't read
                log.warning("%s: a malformed message on Redis is dropped: %r", name, error)
            stop.wait(RETRY_SECONDS)

    def _receive_messages(self) -> Generator[None]:
        """Take a photo's message while the extractor is idle; of which job does not matter."""
        with open_redis(self._settings) as client:
            while True:
                if not self._idle.wait(POP_SECONDS):
                    client.ping()
                elif client.brpop(WakeupQueue.BULK, POP_SECONDS) is not None:
                    self._idle.clear()
                    self._arrived.set()
                yield

    def _receive_queries(self) -> Generator[None]:
        """Take the messages of queries, which are described beside batches."""
        with open_redis(self._settings) as client:
            while True:
                if client.brpop(WakeupQueue.QUERY, POP_SECONDS) is not None:
                    self._arrived.set()
                    self._on_query()
                yield

    def _serve_control(self) -> Generator[None]:
        """Send heartbeats, and answer the questions of `celery inspect` and Flower."""
        with self._app.connection_for_read() as connection:
            node = self._app.control.mailbox.Node(
                self._name,
                state=None,
                channel=connection.default_channel,
                handlers=self._handlers(connection),
            )
            node.listen(callback=node.handle_message)
            self._send_heartbeat("worker-online")
            while True:
                with contextlib.suppress(TimeoutError):
                    connection.drain_events(timeout=HEARTBEAT_SECONDS / 2)
                connection.default_channel.client.ping()
                if time.monotonic() > self._next_heartbeat:
                    self._send_heartbeat("worker-heartbeat")
                yield

    def _send_heartbeat(self, event: str) -> None:
        self._next_heartbeat = time.monotonic() + HEARTBEAT_SECONDS
        self._wakeups.send_event(
            event,
            freq=HEARTBEAT_SECONDS,
            active=len(self._wakeups.active),
            loadavg=load_average(),
            sw_ident="placewise",
            sw_ver=version("placewise"),
            sw_sys=platform.system(),
            pid=os.getpid(),
        )

    def _handlers(self, connection: Connection) -> dict[str, Callable[..., Any]]:
        answers: dict[str, Callable[[], Any]] = {
            "ping": lambda: {"ok": "pong"},
            "stats": lambda: self._stats(connection),
            "active_queues": lambda: [_describe_queue(queue) for queue in WakeupQueue],
            "registered": lambda: [task_name(kind) for kind in EXTRACTOR_JOBS],
            "conf": lambda: self._settings.model_dump(
                mode="json", include={"batch_photos", "device"}
            ),
            # Jobs that run are in Flower's list of tasks; none is held back here.
            **dict.fromkeys(("active", "scheduled", "reserved", "revoked"), list),
            # Events are always on.
            **dict.fromkeys(("enable_events", "disable_events"), dict),
        }
        return {
            name: lambda _state, _answer=answer, **_: _answer() for name, answer in answers.items()
        }

    def _stats(self, connection: Connection) -> dict[str, Any]:
        return {
            **self._read_state(),
            "total": {},
            "pid": os.getpid(),
            "uptime": round(time.monotonic() - self._started),
            "pool": {"implementation": "batches of jobs of one model"},
            "broker": {"hostname": connection.hostname, "transport": "redis"},
        }


def _describe_queue(queue: WakeupQueue) -> dict[str, Any]:
    flags = dict.fromkeys(("exclusive", "auto_delete"), False)
    unset = dict.fromkeys(("exchange", "alias", "queue_arguments", "binding_arguments"))
    return {"name": queue, "routing_key": queue, "durable": True, "no_ack": True, **flags, **unset}
