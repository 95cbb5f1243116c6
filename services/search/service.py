"""Search service process: syncs with the catalog, and serves searches over HTTP.

The HTTP API is for the gateway and the steward only. It requires no API key and exposes which
photos a map has: listen on an internal network.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from uuid import UUID

from fastapi import FastAPI, Response
from prometheus_client import CollectorRegistry
from pydantic import BaseModel

from services.http_connections import ConnectionLimits, Connections
from services.http_server import http_server, listen, reachable_url, stop_on_signals
from services.request_log import RequestLogMiddleware
from services.search.metrics import MeteredSearch
from services.search.worker import SearchWorker
from services.service_process import Announce, service_process, start_service_threads
from shared.catalog.installation import open_installation_store
from shared.catalog.processes import process_heartbeat
from shared.config.settings import Settings
from shared.http.problem_details import PROBLEM_RESPONSES, install_exception_handlers
from shared.search_api.protocol import (
    MatchRequest,
    MatchResponse,
    PoseRequest,
    PoseResponse,
    ReplicationLag,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.telemetry.metrics_server import METRICS_CONTENT_TYPE, serve_metrics

# Several syncs were missed, or loading takes too long.
MAX_READY_LAG_SECONDS = 5.0


class Readiness(BaseModel):
    """Readiness of a search worker.

    `status` is `ready`, `degraded` (ready, but without the chunks in `missing`) or `not ready`, for
    the given `reasons`.
    """

    status: str
    reasons: list[str]
    lags: dict[UUID, ReplicationLag]
    missing: list[str]


def create_search_app(worker: SearchWorker, registry: CollectorRegistry | None = None) -> FastAPI:
    """Create the HTTP API of a worker, which the caller keeps in sync with the catalog."""
    app = FastAPI(
        title="Placewise search",
        description="Cosine top-k on every map, matches of local features, and poses.",
        responses=PROBLEM_RESPONSES,
    )
    install_exception_handlers(app)
    metrics = MeteredSearch(worker, registry)
    app.add_middleware(RequestLogMiddleware, quiet=True)

    @app.post("/search", operation_id="search", response_model=SearchResponse)
    def search(request: SearchRequest) -> Response:
        """Search for the rows that are most similar to the referenced one."""
        # Serialised here, because FastAPI would validate the response again.
        return Response(metrics.search(request).model_dump_json(), media_type="application/json")

    @app.post("/match", operation_id="match", response_model=MatchResponse)
    def match(request: MatchRequest) -> Response:
        """Match the local features of a query with those of photos."""
        return Response(metrics.match(request).model_dump_json(), media_type="application/json")

    @app.post("/pose", operation_id="estimate_pose", response_model=PoseResponse)
    def estimate_pose(request: PoseRequest) -> Response:
        """Compute the pose of a query in a reconstruction of any map."""
        answer = metrics.estimate_pose(request)
        return Response(answer.model_dump_json(), media_type="application/json")

    # Async like the probes, so that it answers while all threads of the pool are searching.
    @app.get("/status", operation_id="status", response_model=SearchStatus)
    async def status() -> SearchStatus:
        """Report what this worker has loaded, and its replication lag."""
        return worker.status()

    @app.get("/livez", operation_id="livez")
    async def livez() -> dict[str, str]:
        """Liveness probe: the process answers; nothing else is checked."""
        return {"status": "alive"}

    @app.get("/readyz", operation_id="readyz", response_model=Readiness)
    async def readyz(response: Response) -> Readiness:
        """Readiness probe: 503 while an active generation lags behind the catalog.

        An unreadable chunk makes the worker `degraded`; it still answers with the other chunks,
        because a restart would not help.
        """
        readiness = _check_readiness(worker)
        response.status_code = 503 if readiness.reasons else 200
        return readiness

    @app.get("/metrics", operation_id="metrics", response_class=Response)
    async def read_metrics() -> Response:
        """Prometheus metrics in text format."""
        return Response(metrics.render(), media_type=METRICS_CONTENT_TYPE)

    return app


def _check_readiness(worker: SearchWorker) -> Readiness:
    """Compute the readiness; a generation that is being built may lag, as no query uses it yet."""
    status = worker.status()
    reasons = []
    if worker.replication_lag.catalog_read_at is None:
        reasons.append("the catalog has not been read yet")
    for generation_id, lag in status.lags.items():
        if not lag.answers:
            continue
        if lag.seconds > MAX_READY_LAG_SECONDS or generation_id not in status.versions:
            reasons.append(
                f"generation {generation_id} is {lag.versions} versions behind, "
                f"last current {lag.seconds:.1f} s ago"
            )
    return Readiness(
        status="not ready" if reasons else "degraded" if status.incomplete else "ready",
        reasons=reasons,
        lags=status.lags,
        missing=list(status.missing),
    )


def serve_search(settings: Settings, announce: Announce) -> None:
    """Serve searches on HOST and PORT until SIGTERM.

    Raises:
        Misconfigured: `address_in_use`; also as `service_process` raises it.
    """
    stop = threading.Event()
    with service_process(settings, "search") as catalog:
        store = open_installation_store(catalog, settings, exclusive=False)
        with listen(settings.host, settings.port) as listener:
            host, port = listener.getsockname()[:2]
            registry = CollectorRegistry()
            worker = SearchWorker.from_settings(catalog, store, settings)
            url = reachable_url(host, port)
            # Its clients are a few gateways, with one connection for each concurrent query.
            limits = replace(ConnectionLimits.of(settings), per_address=0)
            server = http_server(create_search_app(worker, registry), Connections(limits))
            threads = start_service_threads(
                {
                    "search sync": worker.run,
                    "search sync of building generations": worker.run_building,
                },
                stop,
            )
            try:
                with (
                    process_heartbeat(catalog, "search", worker.state),
                    serve_metrics(settings, registry),
                    stop_on_signals(server),
                ):
                    announce(
                        f"Placewise search listens on {url}\n"
                        f"  health:   {url}/readyz   {url}/metrics"
                    )
                    server.run(sockets=[listener])
            finally:
                stop.set()
                for thread in threads:
                    thread.join()
