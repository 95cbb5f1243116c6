"""Wakeups as Celery messages: the Celery application and a non-blocking sender.

Celery carries wakeups only; the job table is the source of truth. A message names no job. Its task
drains the table for a few seconds, and Flower shows the task's result. When Redis loses, duplicates
or redelivers a message, the cost is at most one query of the table: claims skip the jobs of other
workers, and a worker that lost its lease can't commit.

Messages are sent from a thread, so that no request waits for Redis.
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
DRAIN_SECONDS = 10.0  # that a worker spends on jobs for one message, beside the last batch
VISIBILITY_SECONDS = 900  # after which an unacknowledged message is delivered again

# Interval of the search for unacknowledged messages of dead workers; kombu's defaults (10 s, every
# tenth time) would make it 100 s.
UNACKED_RESTORE_SECONDS = 5
BROKER_TIMEOUT_SECONDS = 5


def create_celery_app(settings: Settings) -> Celery:
    """Create the Celery application for senders and workers.

    It uses JSON only and no result backend. A message is acknowledged after its drain, so the
    message of a killed worker is delivered again after VISIBILITY_SECONDS, which is longer than
    any drain.

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
        task_serializer="json",
        result_backend=None,
        task_ignore_result=True,
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        worker_prefetch_multiplier=1,
        task_queues=[_queue(queue) for queue in WakeupQueue],
        task_default_queue=WakeupQueue.BULK,
        task_create_missing_queues=False,
        task_track_started=False,
        task_send_sent_event=False,
        worker_send_task_events=True,  # Flower's view
        worker_cancel_long_running_tasks_on_connection_loss=False,  # drains are short and fenced
        worker_soft_shutdown_timeout=DRAIN_SECONDS,
        worker_enable_soft_shutdown_on_idle=True,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        broker_connection_timeout=BROKER_TIMEOUT_SECONDS,
        broker_pool_acquire_timeout=BROKER_TIMEOUT_SECONDS,
        broker_transport_options={
            "visibility_timeout": VISIBILITY_SECONDS,
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


def _queue(queue: WakeupQueue) -> Queue:
    # An exchange of its own: through the default one every message would reach both queues.
    return Queue(queue, Exchange(queue), routing_key=queue)  # type: ignore[no-untyped-call]


# More pending messages would be of no use: one message wakes one free worker, and a worker that
# finds more jobs than it can run sends the next.
MAX_PENDING_WAKEUPS = 16
# A burst of uploads sends one message.
DEBOUNCE_SECONDS = 0.01
WARNING_INTERVAL_SECONDS = 60.0  # between two log lines about an unreachable Redis
BROKER_ERRORS = (OperationalError, KombuError, RedisError, OSError, TimeoutError)


class CeleryWakeups:
    """Sends wakeups from a thread, which `close` ends.

    Wakeups are dropped while Redis is unreachable.
    """

    def __init__(self, app: Celery, settings: Settings) -> None:
        assert settings.redis_url is not None, "create_celery_app has checked it"
        self._app = app
        self._redis = Redis.from_url(
            settings.redis_url.get_secret_value(),
            socket_timeout=BROKER_TIMEOUT_SECONDS,
            socket_connect_timeout=BROKER_TIMEOUT_SECONDS,
        )
        self._pending: dict[WakeupQueue, threading.Event] = {
            queue: threading.Event() for queue in WakeupQueue
        }
        self._any_pending = threading.Event()
        self._stop = threading.Event()
        self._next_warning = 0.0
        self._sender = threading.Thread(target=self._run, name="wakeups", daemon=True)
        self._sender.start()

    def send(self, queue: WakeupQueue = WakeupQueue.BULK) -> None:
        self._pending[queue].set()
        self._any_pending.set()

    def close(self) -> None:
        self._stop.set()
        self._any_pending.set()
        self._sender.join(timeout=2 * BROKER_TIMEOUT_SECONDS)
        self._redis.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._any_pending.wait()
            if self._stop.wait(DEBOUNCE_SECONDS):
                return
            self._any_pending.clear()
            for queue in WakeupQueue:
                if self._pending[queue].is_set():
                    self._pending[queue].clear()
                    self._publish(queue)

    def _publish(self, queue: WakeupQueue) -> None:
        try:
            if int(self._redis.llen(queue)) >= MAX_PENDING_WAKEUPS:
                return
            self._app.send_task(DRAIN_TASK, queue=queue, ignore_result=True, retry=False)
        except BROKER_ERRORS as error:
            if time.monotonic() > self._next_warning:
                self._next_warning = time.monotonic() + WARNING_INTERVAL_SECONDS
                log.warning("Redis is unreachable, wakeups are dropped: %s", error)
