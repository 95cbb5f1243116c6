"""`/livez`, `/readyz`, `/api/v1/health`: does the process live, can it serve, how are its parts."""

from __future__ import annotations

import time
from importlib.metadata import version

from fastapi import APIRouter, Response
from pydantic import Field
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from services.gateway.admission import AdmissionControl, AdmissionDep, UploadKind
from services.gateway.authentication import READ
from services.gateway.dependencies import GatewayContext, GatewayDep
from services.gateway.schemas import ResponseModel
from shared.catalog.database_errors import to_unavailable
from shared.catalog.maps import Map
from shared.config.settings import Settings
from shared.errors import PlacewiseError, StorageFull

probe_router = APIRouter(tags=["operations"])
router = APIRouter(tags=["operations"])

STATUSES_WORST_FIRST = ("unhealthy", "degraded", "healthy")

MAX_NAMED_CHUNKS = 10

VERSION = version("placewise")


class ServiceResponse(ResponseModel):
    service: str
    version: str
    status: str
    description: str
    docs: str
    redoc: str
    health: str
    api: str


class ProbeResponse(ResponseModel):
    status: str


class ComponentStatus(ResponseModel):
    status: str
    detail: str | None = None


class LoadResponse(ResponseModel):
    """How full things are; a full one is refused more (429, 507), and is not unhealthy."""

    waiting_jobs: int = Field(description="without queries, and what a model change queued")
    max_queued_jobs: int
    waiting_queries: int
    max_queued_queries: int
    finished_per_second: float = Field(description="photos, over the last minute")
    receiving_uploads: int = Field(description="by this gateway, now")
    receiving_queries: int
    max_concurrent_uploads: int
    free_bytes: int | None = Field(description="of this machine's disk; null: nothing lies there")
    min_free_bytes: int


class HealthResponse(ResponseModel):
    status: str
    version: str
    uptime_seconds: float
    parts: dict[str, ComponentStatus]
    load: LoadResponse | None = Field(description="null while the catalog is away")


def service_info() -> ServiceResponse:
    """What this is and where to look."""
    return ServiceResponse(
        service="Placewise",
        version=VERSION,
        status="running",
        description="Photo in, place out: visual place recognition over HTTP.",
        docs="/docs",
        redoc="/redoc",
        health="/api/v1/health",
        api="/api/v1",
    )


@probe_router.head("/livez", include_in_schema=False)
@probe_router.get("/livez", operation_id="livez", response_model=ProbeResponse)
def livez() -> ProbeResponse:
    """The process answers; nothing else is looked at."""
    return ProbeResponse(status="alive")


@probe_router.head("/readyz", include_in_schema=False)
@probe_router.get("/readyz", operation_id="readyz", response_model=ProbeResponse)
def readyz(gateway: GatewayDep, room: AdmissionDep, response: Response) -> ProbeResponse:
    """503 while a part that every call needs is away. What is only degraded is ready: without some
    shards or chunks the rest still answers, and on a full disk photos can be deleted."""
    ready = all(part.status != "unhealthy" for part in _check_components(gateway, room).values())
    response.status_code = 200 if ready else 503
    return ProbeResponse(status="ready" if ready else "not ready")


@router.head("/health", include_in_schema=False, dependencies=[READ])
@router.get("/health", operation_id="health", response_model=HealthResponse, dependencies=[READ])
def read_health(gateway: GatewayDep, admission: AdmissionDep, response: Response) -> HealthResponse:
    """The state of each part; 503 when one is away, or `degraded`: chunks or shards of the map
    can't be searched, or uploads are refused because the disk is full."""
    parts = _check_components(gateway, admission)
    states = {part.status for part in parts.values()}
    response.status_code = 200 if states == {"healthy"} else 503
    return HealthResponse(
        status=next(state for state in STATUSES_WORST_FIRST if state in states),
        version=VERSION,
        uptime_seconds=time.monotonic() - gateway.started_monotonic,
        parts=parts,
        load=_load_response(gateway.settings, admission)
        if parts["catalog"].status == "healthy"
        else None,
    )


def _load_response(settings: Settings, admission: AdmissionControl) -> LoadResponse:
    waiting = admission.queue_depth()
    return LoadResponse(
        waiting_jobs=waiting.jobs,
        max_queued_jobs=settings.max_queued_jobs,
        waiting_queries=waiting.queries,
        max_queued_queries=settings.max_queued_queries,
        finished_per_second=waiting.finished_per_second,
        receiving_uploads=admission.active_uploads(UploadKind.UPLOAD),
        receiving_queries=admission.active_uploads(UploadKind.QUERY),
        max_concurrent_uploads=settings.max_concurrent_uploads,
        free_bytes=admission.disk.free_bytes(),
        min_free_bytes=settings.min_free_bytes,
    )


def _check_components(
    gateway: GatewayContext, room: AdmissionControl
) -> dict[str, ComponentStatus]:
    return {
        "catalog": _check_catalog(gateway),
        "object_store": _check_object_store(gateway, room),
        "search": _check_search(gateway),
    }


def _check_catalog(gateway: GatewayContext) -> ComponentStatus:
    try:
        with gateway.catalog.read() as session:
            session.scalar(select(Map.id).limit(1))
    except SQLAlchemyError as error:
        unavailable = to_unavailable(error)
        detail = unavailable.detail if unavailable else "the catalog can't be reached"
        return ComponentStatus(status="unhealthy", detail=detail)
    return ComponentStatus(status="healthy")


def _check_object_store(gateway: GatewayContext, room: AdmissionControl) -> ComponentStatus:
    try:
        gateway.store.check()
        room.disk.check()
    except StorageFull as error:
        return ComponentStatus(status="degraded", detail=f"uploads are refused: {error.detail}")
    except PlacewiseError as error:
        return ComponentStatus(status="unhealthy", detail=error.detail)
    return ComponentStatus(status="healthy")


def _check_search(gateway: GatewayContext) -> ComponentStatus:
    try:
        status = gateway.search.status()
    except PlacewiseError as error:
        return ComponentStatus(status="unhealthy", detail=error.detail)
    wrong = []
    if status.away:
        wrong.append(f"no search worker answers for: {', '.join(status.away)}")
    if status.missing:
        named = ", ".join(status.missing[:MAX_NAMED_CHUNKS])
        more = len(status.missing) - MAX_NAMED_CHUNKS
        wrong.append(
            f"{len(status.missing)} chunks can't be read: {named}"
            + (f" and {more} more" if more > 0 else "")
            + " (placewise verify --repair)"
        )
    if wrong:
        return ComponentStatus(status="degraded", detail="; ".join(wrong))
    return ComponentStatus(status="healthy", detail=f"{status.rows} rows in memory")
