"""Steward service process: a thread each for periodic tasks, evaluations, batches and webhooks."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading

from prometheus_client import CollectorRegistry

from services.service_process import (
    SIGNAL_POLL_SECONDS,
    Announce,
    service_process,
    start_service_threads,
)
from services.steward.batches.worker import BatchWorker
from services.steward.evaluation_worker import EvaluationWorker
from services.steward.library_sync import LibrarySyncWorker
from services.steward.metrics import StewardMetrics
from services.steward.scheduler import Scheduler
from services.steward.webhooks import WebhookDispatcher
from shared.catalog.installation import open_installation_store
from shared.catalog.processes import process_heartbeat
from shared.config.settings import Settings
from shared.jobs.celery_messages import CeleryJobMessages, create_celery_app
from shared.search_api.client import HttpSearchClient
from shared.telemetry.metrics_server import serve_metrics


def serve_steward(settings: Settings, announce: Announce) -> None:
    """Run all tasks of the steward until SIGTERM.

    Raises:
        Misconfigured: `search_missing`, `redis_missing`; also as `service_process` raises it.
    """
    stop = threading.Event()
    with (
        service_process(settings, "steward") as catalog,
        process_heartbeat(catalog, "steward"),
        contextlib.closing(CeleryJobMessages(create_celery_app(settings), settings)) as wakeups,
        HttpSearchClient.from_settings(settings) as search,
        serve_metrics(settings, registry := CollectorRegistry()),
    ):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        store = open_installation_store(catalog, settings, exclusive=False)
        name = f"steward-{socket.gethostname()}-{os.getpid()}"
        metrics = StewardMetrics(registry)
        batches = BatchWorker(catalog, store, wakeups, settings, name, metrics)
        scheduler = Scheduler(catalog, store, wakeups, settings, metrics)
        evaluator = EvaluationWorker(catalog, store, search, settings, name, metrics)
        libraries = LibrarySyncWorker(catalog, settings, name, metrics)
        webhooks = WebhookDispatcher(catalog, settings)
        threads = start_service_threads(
            {
                "evaluator": evaluator.run,
                "libraries": libraries.run,
                "batches": batches.run,
                "webhooks": webhooks.run,
                "steward": scheduler.run,
            },
            stop,
        )
        announce("Placewise steward is running")
        while not stop.wait(SIGNAL_POLL_SECONDS):
            pass
        for thread in threads:
            thread.join()
