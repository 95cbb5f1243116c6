"""The Celery application that carries hints, and nothing else: the truth is in the job table.

A message names no job. The task drains the table for a few seconds; its result is what Flower
shows. Whatever Redis does to messages (loses them, doubles them, delivers them again while they are
worked on) costs a look at the table at most: claims skip what others hold, and a worker that was
taken over can't commit.

Hints as Celery messages, sent from a thread so that no request waits for Redis.
"""

from __future__ import annotations

import logging
import threading
import time

from celery import Celery
from kombu.entity import Exchange, Queue
from kombu.exceptions import KombuError, OperationalError
from redis import Redis
from redis.exceptions import RedisError

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.jobs.wakeups import WakeupQueue

log = logging.getLogger(__name__)

DRAIN_TASK = "placewise.drain"

# A look at Redis for messages whose worker fell silent; kombu's own 10 s x 10 would make it 100 s.
UNACKED_RESTORE_SECONDS = 5
BROKER_TIMEOUT_SECONDS = 5


def create_celery_app(settings: Settings) -> Celery:
    """The application, for sending and for working; Misconfigured without REDIS_URL.

    JSON only, no result backend. A message is acknowledged when its drain has ended, so a killed
    worker's comes back after `visibility_seconds`, which outlasts any drain.
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
        task_serializer="json",
        result_backend=None,
        task_ignore_result=True,
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        worker_prefetch_multiplier=1,
        task_queues=[_queue(lane) for lane in WakeupQueue],
        task_default_queue=WakeupQueue.BULK,
        task_create_missing_queues=False,
        task_track_started=False,
        task_send_sent_event=False,
        worker_send_task_events=True,  # Flower's view
        worker_cancel_long_running_tasks_on_connection_loss=False,  # drains are short and fenced
        worker_soft_shutdown_timeout=settings.drain_seconds,
        worker_enable_soft_shutdown_on_idle=True,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        broker_connection_timeout=BROKER_TIMEOUT_SECONDS,
        broker_pool_acquire_timeout=BROKER_TIMEOUT_SECONDS,
        broker_transport_options={
            "visibility_timeout": settings.visibility_seconds,
            "unacked_restore_interval": UNACKED_RESTORE_SECONDS,
            "unacked_restore_throttle": 1,
            "queue_order_strategy": "priority",  # in the order of `task_queues`: queries first
            "socket_timeout": BROKER_TIMEOUT_SECONDS,
            "socket_connect_timeout": BROKER_TIMEOUT_SECONDS,
            "socket_keepalive": True,
            "health_check_interval": 30,
            "retry_on_timeout": False,
        },
    )
    return app


def _queue(lane: WakeupQueue) -> Queue:
    # With an exchange of its own: on the default one every hint would reach both lanes.
    return Queue(lane, Exchange(lane), routing_key=lane)  # type: ignore[no-untyped-call]


# Waiting messages that are worth having: one wakes one free worker, and a worker that finds more
# than it can do sends the next.
MAX_PENDING_WAKEUPS = 16
# A burst of uploads is one hint.
DEBOUNCE_SECONDS = 0.01
WARNING_INTERVAL_SECONDS = 60.0  # between two lines of the log about Redis being away
BROKER_ERRORS = (OperationalError, KombuError, RedisError, OSError, TimeoutError)


class CeleryWakeups:
    """Sends hints; `close` ends its thread. While Redis is away, hints are dropped."""

    def __init__(self, app: Celery, settings: Settings) -> None:
        assert settings.redis_url is not None, "make_celery has checked it"
        self._app = app
        self._redis = Redis.from_url(
            settings.redis_url.get_secret_value(),
            socket_timeout=BROKER_TIMEOUT_SECONDS,
            socket_connect_timeout=BROKER_TIMEOUT_SECONDS,
        )
        self._wanted: dict[WakeupQueue, threading.Event] = {
            lane: threading.Event() for lane in WakeupQueue
        }
        self._any = threading.Event()
        self._stop = threading.Event()
        self._silent_until = 0.0
        self._sender = threading.Thread(target=self._run, name="hints", daemon=True)
        self._sender.start()

    def send(self, lane: WakeupQueue = WakeupQueue.BULK) -> None:
        self._wanted[lane].set()
        self._any.set()

    def close(self) -> None:
        self._stop.set()
        self._any.set()
        self._sender.join(timeout=2 * BROKER_TIMEOUT_SECONDS)
        self._redis.close()

    def _run(self) -> None:
        while True:
            self._any.wait()
            if self._stop.is_set():
                return
            self._stop.wait(DEBOUNCE_SECONDS)
            self._any.clear()
            for lane in WakeupQueue:
                if self._wanted[lane].is_set():
                    self._wanted[lane].clear()
                    self._publish(lane)

    def _publish(self, lane: WakeupQueue) -> None:
        try:
            if int(self._redis.llen(lane)) >= MAX_PENDING_WAKEUPS:
                return
            self._app.send_task(DRAIN_TASK, queue=lane, ignore_result=True, retry=False)
        except BROKER_ERRORS as error:
            if time.monotonic() > self._silent_until:
                self._silent_until = time.monotonic() + WARNING_INTERVAL_SECONDS
                log.warning("Redis can't be reached, hints are dropped for now: %s", error)
