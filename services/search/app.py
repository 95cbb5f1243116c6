"""The search port over HTTP: `POST /search` and `GET /status`, probes and metrics.

For the gateway and the steward alone. It asks for no key and tells which photos a map has: listen
where only they can reach it.
"""

from __future__ import annotations

from uuid import UUID

from fastapi import FastAPI, Response
from prometheus_client import CollectorRegistry
from pydantic import BaseModel

from services.call_log import RequestLogMiddleware
from services.search.metrics import MeteredSearch
from services.search.worker import SearchWorker
from shared.problems import PROBLEM_RESPONSES, install_exception_handlers
from shared.search_protocol import ReplicationLag, SearchRequest, SearchResponse, SearchStatus
from shared.telemetry.metrics_server import METRICS_CONTENT_TYPE

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
