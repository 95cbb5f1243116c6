"""The Celery application that carries hints, and nothing else: the truth is in the job table.

A message names no job. The task drains the table for a few seconds; its result is what Flower
shows. Whatever Redis does to messages (loses them, doubles them, delivers them again while they are
worked on) costs a look at the table at most: claims skip what others hold, and a worker that was
taken over can't commit.
"""

from __future__ import annotations

from celery import Celery
from kombu.entity import Exchange, Queue

from shared.errors import Misconfigured
from shared.jobs.hints import WakeupQueue
from shared.settings import Settings

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
