"""`/livez`, `/readyz`, `/api/v1/health`: does the process live, can it serve, how are its parts."""

from __future__ import annotations

import time
from importlib.metadata import version

from fastapi import APIRouter, Response
from pydantic import Field
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from services.gateway.context import Gateway, GatewayDep
from services.gateway.key_check import READ
from services.gateway.room import Kind, Room, RoomDep
from services.gateway.schemas import Answer
from shared.catalog.away import as_unavailable
from shared.catalog.maps import Map
from shared.errors import PlacewiseError, StorageFull
from shared.settings import Settings

probes = APIRouter(tags=["operations"])
router = APIRouter(tags=["operations"])

WORST_FIRST = ("unhealthy", "degraded", "healthy")

MAX_NAMED_CHUNKS = 10

VERSION = version("placewise")


class ServiceAnswer(Answer):
    service: str
    version: str
    status: str
    description: str
    docs: str
    redoc: str
    health: str
    api: str


class ProbeAnswer(Answer):
    status: str


class PartAnswer(Answer):
    status: str
    detail: str | None = None


class LoadAnswer(Answer):
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


class HealthAnswer(Answer):
    status: str
    version: str
    uptime_seconds: float
    parts: dict[str, PartAnswer]
    load: LoadAnswer | None = Field(description="null while the catalog is away")


def service() -> ServiceAnswer:
    """What this is and where to look."""
    return ServiceAnswer(
        service="Placewise",
        version=VERSION,
        status="running",
        description="Photo in, place out: visual place recognition over HTTP.",
        docs="/docs",
        redoc="/redoc",
        health="/api/v1/health",
        api="/api/v1",
    )


@probes.head("/livez", include_in_schema=False)
@probes.get("/livez", operation_id="livez", response_model=ProbeAnswer)
def livez() -> ProbeAnswer:
    """The process answers; nothing else is looked at."""
    return ProbeAnswer(status="alive")


@probes.head("/readyz", include_in_schema=False)
@probes.get("/readyz", operation_id="readyz", response_model=ProbeAnswer)
def readyz(gateway: GatewayDep, room: RoomDep, response: Response) -> ProbeAnswer:
    """503 while a part that every call needs is away. What is only degraded is ready: without some
    shards or chunks the rest still answers, and on a full disk photos can be deleted."""
    ready = all(part.status != "unhealthy" for part in _parts(gateway, room).values())
    response.status_code = 200 if ready else 503
    return ProbeAnswer(status="ready" if ready else "not ready")


@router.head("/health", include_in_schema=False, dependencies=[READ])
@router.get("/health", operation_id="health", response_model=HealthAnswer, dependencies=[READ])
def health(gateway: GatewayDep, room: RoomDep, response: Response) -> HealthAnswer:
    """The state of each part; 503 when one is away, or `degraded`: chunks or shards of the map
    can't be searched, or uploads are refused because the disk is full."""
    parts = _parts(gateway, room)
    states = {part.status for part in parts.values()}
    response.status_code = 200 if states == {"healthy"} else 503
    return HealthAnswer(
        status=next(state for state in WORST_FIRST if state in states),
        version=VERSION,
        uptime_seconds=time.monotonic() - gateway.started,
        parts=parts,
        load=_load(gateway.settings, room) if parts["catalog"].status == "healthy" else None,
    )


def _load(settings: Settings, room: Room) -> LoadAnswer:
    waiting = room.look()
    return LoadAnswer(
        waiting_jobs=waiting.jobs,
        max_queued_jobs=settings.max_queued_jobs,
        waiting_queries=waiting.queries,
        max_queued_queries=settings.max_queued_queries,
        finished_per_second=waiting.finished_per_second,
        receiving_uploads=room.being_received(Kind.UPLOAD),
        receiving_queries=room.being_received(Kind.QUERY),
        max_concurrent_uploads=settings.max_concurrent_uploads,
        free_bytes=room.disk.free_bytes(),
        min_free_bytes=settings.min_free_bytes,
    )


def _parts(gateway: Gateway, room: Room) -> dict[str, PartAnswer]:
    return {
        "catalog": _catalog(gateway),
        "object_store": _object_store(gateway, room),
        "search": _search(gateway),
    }


def _catalog(gateway: Gateway) -> PartAnswer:
    try:
        with gateway.catalog.read() as session:
            session.scalar(select(Map.id).limit(1))
    except SQLAlchemyError as error:
        unavailable = as_unavailable(error)
        detail = unavailable.detail if unavailable else "the catalog can't be reached"
        return PartAnswer(status="unhealthy", detail=detail)
    return PartAnswer(status="healthy")


def _object_store(gateway: Gateway, room: Room) -> PartAnswer:
    try:
        gateway.store.check()
        room.disk.check()
    except StorageFull as error:
        return PartAnswer(status="degraded", detail=f"uploads are refused: {error.detail}")
    except PlacewiseError as error:
        return PartAnswer(status="unhealthy", detail=error.detail)
    return PartAnswer(status="healthy")


def _search(gateway: Gateway) -> PartAnswer:
    try:
        status = gateway.search.status()
    except PlacewiseError as error:
        return PartAnswer(status="unhealthy", detail=error.detail)
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
        return PartAnswer(status="degraded", detail="; ".join(wrong))
    return PartAnswer(status="healthy", detail=f"{status.rows} rows in memory")
