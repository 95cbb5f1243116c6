"""Liveness and readiness probes (`/livez`, `/readyz`) and the health of each component."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.metadata import version

from fastapi import APIRouter, Response
from pydantic import Field
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from services.gateway.admission import AdmissionControl, AdmissionDep, UploadKind
from services.gateway.authentication import READ
from services.gateway.dependencies import ALL_MAPS, NO_PARAMETERS, GatewayContext, GatewayDep
from shared.catalog.database.errors import to_unavailable
from shared.catalog.jobs import is_job_overdue
from shared.catalog.maps import Map, count_failed_photos, list_extractors_in_use
from shared.catalog.processes import PROCESS_TIMEOUT_SECONDS, list_processes
from shared.config.settings import Settings
from shared.errors import PlacewiseError, StorageFull, TooManyRequests
from shared.jobs.queue_depth import QueueDepth
from shared.matching.features import DETECTOR
from shared.responses import ResponseModel
from shared.storage.trash import read_hold

probe_router = APIRouter(tags=["operations"])
router = APIRouter(tags=["operations"], dependencies=[NO_PARAMETERS, ALL_MAPS])

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


class ExtractorProcess(ResponseModel):
    """A running extractor."""

    name: str
    device: str | None = Field(description="`cpu` or `cuda`; null while it starts")
    models: list[str] = Field(description="loaded extractors")
    errors: dict[str, str] = Field(
        description="extractors that can't be loaded, with the error code, such as weights_missing"
    )


class QueueStatus(ComponentStatus):
    """The job queue. `degraded`: Redis takes no messages; jobs are found a little later."""

    oldest_waiting_seconds: float = Field(description="age of the oldest job that waits; 0: none")
    finished_in_last_minute: int = Field(description="photos and queries, also failed ones")


class ExtractorsStatus(ComponentStatus):
    """Whether photos can be described.

    `degraded`: no extractor is alive, a map's extractor can't be loaded, or a job waits much longer
    than usual while none is finished.
    """

    processes: list[ExtractorProcess] = Field(description="extractors with a recent heartbeat")
    failed_photos: dict[str, int] = Field(
        description="map -> number of stored photos that can't be searched for, because their "
        "description failed; GET /search?failed=true lists them"
    )


class LoadResponse(ResponseModel):
    """Load and limits of this gateway.

    At a limit, requests are refused (429, 507), and the service is degraded, not unhealthy.
    """

    waiting_jobs: int = Field(description="queued jobs, without queries and jobs of model changes")
    max_queued_jobs: int
    waiting_queries: int
    max_queued_queries: int
    finished_per_second: float = Field(
        description="processed photos per second, over the last minute"
    )
    receiving_uploads: int = Field(description="uploads being received by this gateway")
    receiving_queries: int
    max_concurrent_uploads: int
    free_bytes: int | None = Field(
        description="free bytes of the local disk; null if nothing is stored on it"
    )
    min_free_bytes: int


class HealthResponse(ResponseModel):
    status: str
    version: str
    uptime_seconds: float
    parts: dict[str, ExtractorsStatus | QueueStatus | ComponentStatus]
    load: LoadResponse | None = Field(description="null while the catalog is unreachable")


def service_info() -> ServiceResponse:
    """Return the name and version of the service, and its links."""
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
@probe_router.get("/livez")
def livez() -> ProbeResponse:
    """Liveness probe: 200 while the process responds. It checks nothing else."""
    return ProbeResponse(status="alive")


@probe_router.head("/readyz", include_in_schema=False)
@probe_router.get(
    "/readyz",
    responses={503: {"model": ProbeResponse, "description": "A component is unavailable."}},
)
def readyz(gateway: GatewayDep, admission: AdmissionDep, response: Response) -> ProbeResponse:
    """Readiness probe: 503 while a component that every request needs is unavailable.

    Degraded components are ready: the other chunks can be searched, and photos can be deleted while
    the disk is full.
    """
    components = _check_components(gateway, admission)
    ready = all(component.status != "unhealthy" for component in components.values())
    response.status_code = 200 if ready else 503
    return ProbeResponse(status="ready" if ready else "not ready")


@router.head("/health", include_in_schema=False, dependencies=[READ])
@router.get(
    "/health",
    operation_id="health",
    responses={503: {"model": HealthResponse, "description": "Not all components are healthy."}},
    dependencies=[READ],
)
def read_health(gateway: GatewayDep, admission: AdmissionDep, response: Response) -> HealthResponse:
    """Get the health of each component; 503 unless all are healthy.

    `degraded`: chunks can't be searched, photos can't be described, uploads are refused
    because the disk or the job queue is full, Redis takes no messages, no steward is running, or
    orphans are not collected.
    """
    components: dict[str, ExtractorsStatus | QueueStatus | ComponentStatus] = {
        **_check_components(gateway, admission),
    }
    has_catalog = components["catalog"].status == "healthy"
    if has_catalog:
        depth = admission.queue_depth()
        components["queue"] = _check_messages(gateway, depth)
        components["extractors"] = _check_extractors(gateway, depth)
        components |= _check_stewards(gateway)
    if components["object_store"].status == "healthy":
        components["object_store"] = _check_collection(gateway)
    statuses = {component.status for component in components.values()}
    response.status_code = 200 if statuses == {"healthy"} else 503
    return HealthResponse(
        status=next(status for status in STATUSES_WORST_FIRST if status in statuses),
        version=VERSION,
        uptime_seconds=time.monotonic() - gateway.started_monotonic,
        parts=components,
        load=_load_response(gateway.settings, admission) if has_catalog else None,
    )


def _load_response(settings: Settings, admission: AdmissionControl) -> LoadResponse:
    depth = admission.queue_depth()
    return LoadResponse(
        waiting_jobs=depth.jobs,
        max_queued_jobs=settings.max_queued_jobs,
        waiting_queries=depth.queries,
        max_queued_queries=settings.max_queued_queries,
        finished_per_second=depth.finished_per_second,
        receiving_uploads=admission.active_uploads(UploadKind.UPLOAD),
        receiving_queries=admission.active_uploads(UploadKind.QUERY),
        max_concurrent_uploads=settings.max_concurrent_uploads,
        free_bytes=admission.disk.free_bytes(),
        min_free_bytes=settings.min_free_bytes,
    )


def _check_components(
    gateway: GatewayContext, admission: AdmissionControl
) -> dict[str, ComponentStatus]:
    return {
        "catalog": _status(lambda: _read_catalog(gateway)),
        "object_store": _status(gateway.store.check, admission.disk.check),
        "search": _check_search(gateway),
        "uploads": _status(admission.check_queue),
    }


def _status(*checks: Callable[[], object]) -> ComponentStatus:
    """The status by checks that raise what is wrong; `degraded` if only uploads are refused."""
    try:
        for check in checks:
            check()
    except (StorageFull, TooManyRequests) as error:
        return ComponentStatus(status="degraded", detail=f"uploads are refused: {error.detail}")
    except PlacewiseError as error:
        return ComponentStatus(status="unhealthy", detail=error.detail)
    except SQLAlchemyError as error:
        unavailable = to_unavailable(error)
        detail = unavailable.detail if unavailable else "the catalog is unreachable"
        return ComponentStatus(status="unhealthy", detail=detail)
    return ComponentStatus(status="healthy")


def _read_catalog(gateway: GatewayContext) -> None:
    with gateway.catalog.read() as session:
        session.scalar(select(Map.id).limit(1))


def _check_collection(gateway: GatewayContext) -> ComponentStatus:
    """Return whether orphans of the object store are collected; the store is reachable."""
    try:
        hold = read_hold(gateway.store)
    except PlacewiseError as error:
        return ComponentStatus(status="unhealthy", detail=error.detail)
    if hold is not None:
        return ComponentStatus(status="degraded", detail=hold)
    return ComponentStatus(status="healthy")


def _check_search(gateway: GatewayContext) -> ComponentStatus:
    try:
        status = gateway.search.status()
    except PlacewiseError as error:
        return ComponentStatus(status="unhealthy", detail=error.detail)
    problems = []
    if status.unwritten:
        problems.append(f"{status.unwritten} chunks are still to be written to Milvus")
    if status.missing:
        named = ", ".join(status.missing[:MAX_NAMED_CHUNKS])
        more = len(status.missing) - MAX_NAMED_CHUNKS
        problems.append(
            f"{len(status.missing)} chunks can't be read: {named}"
            + (f" and {more} more" if more > 0 else "")
            + (
                " (the cache disk of a search worker is full: free space in its PLACEWISE_HOME; "
                "the chunks are then loaded)"
                if status.disk_full
                else " (repair them with placewise storage verify --repair)"
            )
        )
    if problems:
        return ComponentStatus(status="degraded", detail="; ".join(problems))
    place = "Milvus" if gateway.settings.search_engine == "milvus" else "memory"
    detail = f"{status.rows} rows in {place}"
    if status.recalls:
        detail += f", recall of recent answers {min(status.recalls.values()):.3f}"
    return ComponentStatus(status="healthy", detail=detail)


def _check_messages(gateway: GatewayContext, depth: QueueDepth) -> QueueStatus:
    status, detail = "healthy", f"{depth.finished} photos and queries finished in the last minute"
    if depth.oldest_seconds:
        detail = f"the oldest job has waited for {depth.oldest_seconds:.0f} s, {detail}"
    if problem := gateway.wakeups.problem:
        status = "degraded"
        detail = f"Redis takes no messages ({problem}), so photos are described later; {detail}"
    return QueueStatus(
        status=status,
        detail=detail,
        oldest_waiting_seconds=depth.oldest_seconds,
        finished_in_last_minute=depth.finished,
    )


def _check_extractors(gateway: GatewayContext, depth: QueueDepth) -> ExtractorsStatus:
    with gateway.catalog.read() as session:
        extractors = [p for p in list_processes(session) if p.role == "extractor"]
        used = {*list_extractors_in_use(session), DETECTOR}
        overdue = is_job_overdue(session, PROCESS_TIMEOUT_SECONDS)
        failed = count_failed_photos(session)
    details: dict[str, str] = {}
    for process in extractors:
        details |= process.state.get("error_details", {})
    live = [
        ExtractorProcess(
            name=process.name,
            device=process.state.get("device"),
            models=process.state.get("models", []),
            errors={
                name: code for name, code in process.state.get("errors", {}).items() if name in used
            },
        )
        for process in extractors
        if process.is_live
    ]
    problems = sorted(
        {
            f"{name} can't be loaded ({code}): {details.get(name, '')}"
            for process in live
            for name, code in process.errors.items()
        }
    )
    if live and depth.is_stalled:
        problems.append(
            f"no job has finished in the last minute, and one has waited for "
            f"{depth.oldest_seconds:.0f} s (usual: {depth.usual_seconds:.0f} s). Read the "
            "extractors' logs, and restart them"
        )
    # Extractors that are scaled to zero while no job is queued unregister when they stop.
    if not live and (extractors or overdue):
        problems.append("no extractor is running: photos are stored, but not described")
    status = "degraded" if problems else "healthy"
    if failed:  # not degraded: a file that can't be decoded stays until somebody deletes it
        named = ", ".join(f"{number} in the map {name}" for name, number in failed.items())
        problems.append(f"stored photos that can't be searched for: {named}")
    return ExtractorsStatus(
        status=status,
        detail="; ".join([f"{len(live)} running"] * (status == "healthy") + problems),
        processes=live,
        failed_photos=failed,
    )


def _check_stewards(gateway: GatewayContext) -> dict[str, ComponentStatus]:
    """Return the part of the stewards; none where no separate steward has ever registered."""
    with gateway.catalog.read() as session:
        stewards = [p for p in list_processes(session) if p.role == "steward"]
    if not stewards:
        return {}
    live = sum(process.is_live for process in stewards)
    part = ComponentStatus(status="healthy", detail=f"{live} running")
    if not live:
        part = ComponentStatus(
            status="degraded",
            detail="no steward is running: batches, webhooks and model changes wait, and photos of "
            "dead extractors are not described",
        )
    return {"stewards": part}
