"""Extractor service process: a Celery worker that drains the job table on each wakeup message.

One process per GPU with `--pool=solo`, because a forked child can't use CUDA. A drain lasts a few
seconds at most, so that the worker answers `inspect` and Flower in between, and stops soon after it
receives SIGTERM.
"""

from __future__ import annotations

import os
import socket
import threading
from typing import Any

from celery import signals
from prometheus_client import CollectorRegistry

from services.extractor.handlers import DrainStats
from services.extractor.worker import ExtractorWorker
from services.service_process import Announce, service_process, start_service_threads
from shared.catalog.database.session import Catalog
from shared.catalog.installation import open_installation_store
from shared.catalog.processes import process_heartbeat
from shared.config.settings import Settings
from shared.jobs.celery_wakeups import (
    DRAIN_SECONDS,
    DRAIN_TASK,
    CeleryWakeups,
    create_celery_app,
)
from shared.jobs.wakeups import WakeupQueue
from shared.storage import ObjectStore
from shared.telemetry.heartbeat import Heartbeat
from shared.telemetry.metrics_server import serve_metrics


def serve_extractor(settings: Settings, announce: Announce) -> None:
    """Run the extractor until SIGTERM; claimed jobs are then requeued.

    Raises:
        Misconfigured: `redis_missing`.
    """
    with service_process(settings, "extractor") as catalog:
        store = open_installation_store(catalog, settings, exclusive=False)
        _run_celery_worker(catalog, store, settings, announce)


def _run_celery_worker(
    catalog: Catalog, store: ObjectStore, settings: Settings, announce: Announce
) -> None:
    app = create_celery_app(settings)
    wakeups = CeleryWakeups(app, settings)
    name = f"extractor-{socket.gethostname()}-{os.getpid()}"
    registry = CollectorRegistry()
    worker = ExtractorWorker(catalog, store, settings, name, registry=registry)
    heartbeat = Heartbeat(settings.heartbeat_file)
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def drain() -> dict[str, Any]:
        result = worker.drain_once(stop, DRAIN_SECONDS)
        if result is None:
            result = DrainStats(interrupted=True)
        if result.interrupted and not stop.is_set():
            wakeups.send(WakeupQueue.BULK)  # for the jobs that are still queued
        return result.as_dict()

    app.task(drain, name=DRAIN_TASK, ignore_result=True)

    def on_shutdown(**_: object) -> None:
        stop.set()

    def on_worker_ready(**_: object) -> None:
        announce("Placewise extractor is running")

    def on_heartbeat(**_: object) -> None:
        heartbeat.beat()

    def keep_logging_setup(**_: object) -> None:
        pass

    signals.worker_shutting_down.connect(on_shutdown, weak=False)
    signals.worker_ready.connect(on_worker_ready, weak=False)
    # Sent every two seconds by the consumer loop while it is connected to Redis.
    signals.heartbeat_sent.connect(on_heartbeat, weak=False)
    # Keeps Celery from installing its own handlers and formats; `--loglevel` has no effect.
    signals.setup_logging.connect(keep_logging_setup, weak=False)
    try:
        with (
            process_heartbeat(catalog, "extractor", worker.state),
            serve_metrics(settings, registry),
        ):
            worker.warm_up()
            threads += start_service_threads({"fits": worker.fits.run}, stop)
            for queue in WakeupQueue:
                wakeups.send(queue)  # for jobs queued before this worker started
            app.worker_main(
                [
                    "worker",
                    "--pool=solo",
                    "--concurrency=1",
                    f"--hostname={name}@%h",
                    f"--queues={','.join(WakeupQueue)}",
                    "--without-gossip",
                    "--without-mingle",
                ]
            )
    finally:
        signals.setup_logging.disconnect(keep_logging_setup)
        signals.worker_shutting_down.disconnect(on_shutdown)
        signals.worker_ready.disconnect(on_worker_ready)
        signals.heartbeat_sent.disconnect(on_heartbeat)
        stop.set()
        for thread in threads:
            thread.join()
        worker.close()
        wakeups.close()
