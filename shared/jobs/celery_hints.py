"""Hints as Celery messages, sent from a thread so that no request waits for Redis."""

from __future__ import annotations

import logging
import threading
import time

from celery import Celery
from kombu.exceptions import KombuError, OperationalError
from redis import Redis
from redis.exceptions import RedisError

from shared.jobs.celery_app import BROKER_TIMEOUT_SECONDS, DRAIN_TASK
from shared.jobs.hints import WakeupQueue
from shared.settings import Settings

log = logging.getLogger(__name__)

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
