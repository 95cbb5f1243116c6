"""The search service: one worker that follows the catalog, registers and answers HTTP.

The search port over HTTP: `POST /search` and `GET /status`, probes and metrics.

For the gateway and the steward alone. It asks for no key and tells which photos a map has: listen
where only they can reach it.

A search worker's entry in the catalog: that it lives, and what it has loaded.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from uuid import UUID

import uvicorn
from fastapi import FastAPI, Response
from prometheus_client import CollectorRegistry
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError

from services.http_connections import ConnectionLimits, Connections
from services.http_server import http_server, listen, reachable_url, stop_on_signals
from services.request_log import RequestLogMiddleware
from services.search.metrics import MeteredSearch
from services.search.worker import SearchWorker
from services.service_threads import start_service_thread
from shared.catalog.database_errors import OutageLog
from shared.catalog.processes import delete_search_worker, upsert_search_worker
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.http.problem_details import PROBLEM_RESPONSES, install_exception_handlers
from shared.ids import new_id
from shared.search_api.protocol import ReplicationLag, SearchRequest, SearchResponse, SearchStatus
from shared.storage import ObjectStore
from shared.telemetry.metrics_server import METRICS_CONTENT_TYPE, serve_metrics

log = logging.getLogger(__name__)

# Several looks at the catalog were missed, or loading takes that long.
MAX_READY_LAG_SECONDS = 5.0


class Readiness(BaseModel):
    """`status` is `ready`, `degraded` (ready, without the chunks in `missing`) or `not ready`, for
    `reasons`."""

    status: str
    shard: str
    reasons: list[str]
    lags: dict[UUID, ReplicationLag]
    missing: list[str]


def create_search_app(worker: SearchWorker, registry: CollectorRegistry | None = None) -> FastAPI:
    """The HTTP form of one worker, which someone else makes follow the catalog."""
    app = FastAPI(
        title="Placewise search",
        description=f"Exact cosine top-k on shard {worker.shard} of every map.",
        responses=PROBLEM_RESPONSES,
    )
    install_exception_handlers(app)
    metrics = MeteredSearch(worker, registry)
    app.add_middleware(RequestLogMiddleware, quiet=True)

    @app.post("/search", operation_id="search", response_model=SearchResponse)
    def search(request: SearchRequest) -> Response:
        """The rows of this shard that are most similar to the one that is referred to."""
        # Written here: the framework would check again what was built a moment ago.
        return Response(metrics.search(request).as_json(), media_type="application/json")

    # On the event loop, as the probes are: it has to answer while every thread is searching.
    @app.get("/status", operation_id="status", response_model=SearchStatus)
    async def status() -> SearchStatus:
        """What this worker holds, and how far it has followed."""
        return worker.status()

    @app.get("/livez", operation_id="livez")
    async def livez() -> dict[str, str]:
        """The process answers; nothing else is looked at."""
        return {"status": "alive"}

    @app.get("/readyz", operation_id="readyz", response_model=Readiness)
    async def readyz(response: Response) -> Readiness:
        """503 while what answers is behind the catalog. A chunk that can't be read makes the
        worker `degraded`, and the rest is answered: no restart would mend it."""
        found = check_readiness(worker)
        response.status_code = 503 if found.reasons else 200
        return found

    @app.get("/metrics", operation_id="metrics", response_class=Response)
    async def read_metrics() -> Response:
        """Prometheus' text format."""
        return Response(metrics.render(), media_type=METRICS_CONTENT_TYPE)

    return app


def check_readiness(worker: SearchWorker) -> Readiness:
    """A generation that is only being built may lag: no one asks for it yet."""
    status = worker.status()
    reasons = []
    if not worker.replication_lag.has_read_catalog():
        reasons.append("the catalog was not read yet")
    for generation_id, lag in status.lags.items():
        if not lag.answers:
            continue
        if lag.seconds > MAX_READY_LAG_SECONDS or generation_id not in status.versions:
            reasons.append(
                f"generation {generation_id} is {lag.versions} versions behind, "
                f"level {lag.seconds:.1f} s ago"
            )
    return Readiness(
        status="not ready" if reasons else "degraded" if status.missing else "ready",
        shard=status.shard,
        reasons=reasons,
        lags=status.lags,
        missing=list(status.missing),
    )


CHANGE_POLL_SECONDS = 0.5  # between two looks at what is loaded: a switch waits for the news
HEARTBEAT_SECONDS = 2.0  # between two entries without news; DEAD_SECONDS is five of them


class WorkerHeartbeat:
    """Writes the entry. A thread of its own: loading may take minutes, and who loads lives."""

    def __init__(
        self, catalog: Catalog, worker: SearchWorker, name: str, url: str | None = None
    ) -> None:
        self.id = new_id()
        self._catalog = catalog
        self._worker = worker
        self._name = name
        self._url = url
        self._sent_versions: tuple[Mapping[UUID, int], Sequence[str]] | None = None
        self._sent_at = 0.0

    def run(self, stop: threading.Event) -> None:
        """Keep the entry until `stop` is set, and remove it then."""
        outage = OutageLog("search worker's entry")
        while not stop.is_set():
            try:
                self.send_if_due()
                outage.record_success()
            except SQLAlchemyError as error:
                outage.record_error(error)
            stop.wait(CHANGE_POLL_SECONDS)
        try:
            with self._catalog.write() as session:
                delete_search_worker(session, self.id)
        except SQLAlchemyError as error:
            log.warning("search could not sign off, the steward will: %s", error)

    def send_if_due(self) -> None:
        """Write what there is to tell: news at once, else a heartbeat when it is due."""
        status = self._worker.status()
        news = status.loaded, status.missing
        if news == self._sent_versions and time.monotonic() - self._sent_at < HEARTBEAT_SECONDS:
            return
        with self._catalog.write() as session:
            upsert_search_worker(session, self.id, self._name, self._url, self._worker.shard, *news)
        self._sent_versions, self._sent_at = news, time.monotonic()


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
