"""The search service: one worker that follows the catalog, registers and answers HTTP."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace

import uvicorn
from prometheus_client import CollectorRegistry

from services.http_connections import ConnectionLimits, Connections
from services.http_server import http_server, listen, reachable_url, stop_on_signals
from services.parts import start_service_thread
from services.search.app import create_search_app
from services.search.presence import WorkerHeartbeat
from services.search.worker import SearchWorker
from shared.catalog.session import Catalog
from shared.errors import Misconfigured
from shared.objects import ObjectStore
from shared.settings import Settings
from shared.telemetry.metrics_server import serve_metrics


@dataclass(slots=True)
class SearchService:
    """A search worker at work; `serve` answers HTTP until the process is asked to stop."""

    url: str
    worker: SearchWorker
    server: uvicorn.Server
    listener: socket.socket
    failed: threading.Event

    def stop(self) -> None:
        """A part has died: stop the others."""
        self.failed.set()
        self.server.should_exit = True

    def serve(self) -> None:
        """Raises Misconfigured (`part_died`) when one of the parts has ended before its time."""
        with stop_on_signals(self.server):
            self.server.run(sockets=[self.listener])
        if self.failed.is_set():
            raise Misconfigured("part_died", "A part of search died; the log above says why.")


@contextlib.contextmanager
def run_search_service(
    settings: Settings, catalog: Catalog, store: ObjectStore
) -> Iterator[SearchService]:
    """Listen on HOST and PORT, follow the catalog with the shard that SEARCH_SHARD names, and
    register. Raises Misconfigured (`address_in_use`)."""
    with listen(settings.host, settings.port) as listener:
        host, port = listener.getsockname()[:2]
        registry = CollectorRegistry()
        worker = SearchWorker(catalog, store, settings, settings.shard)
        url = reachable_url(host, port)
        presence = WorkerHeartbeat(catalog, worker, f"{socket.gethostname()}:{port}", url)
        # Its clients are a few gateways, with a connection for each query under way.
        limits = replace(ConnectionLimits.of(settings), per_address=0)
        server = http_server(create_search_app(worker, registry), Connections(limits))
        running = SearchService(url, worker, server, listener, threading.Event())
        stop = threading.Event()
        parts = [
            start_service_thread(name, part, stop, running.stop)
            for name, part in (
                ("search", worker.run),
                ("search of what is built", worker.run_building),
                ("search's presence", presence.run),
            )
        ]
        try:
            with serve_metrics(settings, registry):
                yield running
        finally:
            stop.set()
            for part in parts:
                part.join()
