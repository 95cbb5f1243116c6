"""Extractor service process: one for each GPU, a worker to Celery's tools.

Its jobs run in a thread that looks at the job table by itself; the threads that talk to Redis only
make it look sooner, and tell what it does.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import threading

from prometheus_client import CollectorRegistry

from services.extractor.celery_node import CeleryNode
from services.extractor.worker import ExtractorWorker
from services.service_process import (
    SIGNAL_POLL_SECONDS,
    Announce,
    service_process,
    start_service_threads,
)
from shared.catalog.database.session import Catalog
from shared.catalog.installation import open_installation_store
from shared.catalog.processes import process_heartbeat
from shared.config.settings import Settings
from shared.jobs.celery_messages import CeleryJobMessages, create_celery_app
from shared.storage import ObjectStore
from shared.telemetry.metrics_server import serve_metrics

log = logging.getLogger(__name__)


def serve_extractor(settings: Settings, announce: Announce) -> None:
    """Run the extractor until SIGTERM; claimed jobs are then requeued.

    It exits with code 1 if a thread gets no answer from Redis although Redis answers others.

    Raises:
        Misconfigured: `redis_missing`.
    """
    with service_process(settings, "extractor") as catalog:
        store = open_installation_store(catalog, settings, exclusive=False)
        _run_extractor(catalog, store, settings, announce)


def _run_extractor(
    catalog: Catalog, store: ObjectStore, settings: Settings, announce: Announce
) -> None:
    app = create_celery_app(settings)
    name = f"extractor-{os.getpid()}@{socket.gethostname()}"
    registry = CollectorRegistry()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with (
        serve_metrics(settings, registry),
        contextlib.closing(CeleryJobMessages(app, settings, name)) as wakeups,
        contextlib.closing(
            ExtractorWorker(catalog, store, settings, name, registry=registry, wakeups=wakeups)
        ) as worker,
        process_heartbeat(catalog, "extractor", worker.state),
    ):
        on_query = catalog.commits.count_one  # wakes what waits for queries beside a batch
        node = CeleryNode(app, worker.context.settings, name, wakeups, worker.state, on_query)

        def run_jobs(stop: threading.Event) -> None:
            worker.warm_up(stop)
            announce("Placewise extractor is running")
            worker.run(stop, node.wait)

        job_threads = start_service_threads({"jobs": run_jobs, "fits": worker.fits.run}, stop)
        redis_threads = start_service_threads(node.threads(), stop)
        stuck = None
        while stuck is None and not stop.wait(SIGNAL_POLL_SECONDS):
            stuck = node.stuck_thread()
        stop.set()
        for thread in job_threads:
            thread.join()
        if stuck is not None:
            log.critical("restarting: the thread %s got no answer from Redis for long", stuck)
            os._exit(1)  # it may never end
        for thread in redis_threads:
            thread.join()
        wakeups.send_event("worker-offline")
