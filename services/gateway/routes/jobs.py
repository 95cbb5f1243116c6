"""`/jobs`: what is being done, and how far it is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import StreamingResponse
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import ADMIT_JOB, AdmissionDep
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import (
    DEFAULT_MAP,
    GatewayContext,
    GatewayDep,
    JobId,
    MapName,
    parse_cursor,
    wait_for_job,
)
from services.gateway.idempotency import IdempotentDep
from services.gateway.schemas import JobResponse, JobsResponse
from shared.catalog.database_errors import to_unavailable
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES, get_job, list_jobs
from shared.catalog.maps import get_map
from shared.jobs import Job, JobKind, JobState
from shared.jobs.model_changes import cancel_model_change
from shared.jobs.transitions import cancel_batch, cancel_job, retry_batch, retry_job
from shared.jobs.wakeups import queue_for_priority

router = APIRouter(tags=["jobs"])

CATALOG_RETRY_SECONDS = 1.0  # between two looks while the catalog is away
HEARTBEAT_SECONDS = 15.0  # a comment line, so that proxies keep a silent stream open


@router.get("/jobs", operation_id="list_jobs", response_model=JobsResponse, dependencies=[READ])
def read_jobs(
    gateway: GatewayDep,
    state: Annotated[list[JobState] | None, Query()] = None,
    kind: Annotated[list[JobKind] | None, Query()] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 50,
    cursor: Annotated[str | None, Query()] = None,
    map_name: MapName = DEFAULT_MAP,
) -> JobsResponse:
    """Newest first. The `reindex` jobs of a model change under way are listed only by `kind`."""
    before = parse_cursor(cursor)
    with gateway.catalog.read() as session:
        map_id = get_map(session, map_name).id
        found = list_jobs(session, map_id, state or [], kind or [], limit + 1, before)
    page = found[:limit]
    return JobsResponse(
        jobs=[JobResponse.of(read_job_status, map_name) for read_job_status in page],
        next_cursor=str(page[-1].id) if len(found) > limit else None,
    )


@router.get(
    "/jobs/{job_id}", operation_id="get_job", response_model=JobResponse, dependencies=[READ]
)
async def read_job_status(
    gateway: GatewayDep,
    job_id: JobId,
    wait: Annotated[float, Query(ge=0, description="seconds to wait for the end")] = 0.0,
    map_name: MapName = DEFAULT_MAP,
) -> JobResponse:
    """One job; `?wait=20` answers when it ends, or after 20 seconds as it is then."""
    found = await run_in_threadpool(_load_job_of_map, gateway, map_name, job_id)
    if wait and found.state in UNFINISHED_STATES:
        seconds = min(wait, gateway.settings.max_wait_seconds)
        found = await wait_for_job(gateway, job_id, seconds) or found
    return JobResponse.of(found, map_name)


async def _event_stream(request: Request, room: AdmissionDep) -> AsyncIterator[None]:
    """A place among the event streams, until the answer has ended."""
    with room.event_streams.hold(request):
        yield


@router.get(
    "/jobs/{job_id}/events",
    operation_id="job_events",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {}}, "description": "`progress` events"}},
    dependencies=[READ, Depends(_event_stream, scope="request")],
)
async def stream_job_events(
    gateway: GatewayDep,
    job_id: JobId,
    map_name: MapName = DEFAULT_MAP,
) -> StreamingResponse:
    """Server-sent events: a `progress` event with the job at every change, until it ends. Where
    too many are sent already (429, `too_many_event_streams`), poll the job."""
    found = await run_in_threadpool(_load_job_of_map, gateway, map_name, job_id)
    return StreamingResponse(
        _events(gateway, job_id, JobResponse.of(found, map_name), map_name),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


@router.post(
    "/jobs/{job_id}/cancel",
    operation_id="cancel_job",
    response_model=JobResponse,
    dependencies=[WRITE],
)
def cancel_job_by_id(
    gateway: GatewayDep, job_id: JobId, idempotent: IdempotentDep, map_name: MapName = DEFAULT_MAP
) -> JobResponse:
    """End a job at once; what a worker computes for it meanwhile is thrown away."""

    def end(session: Session) -> JobResponse:
        found = get_job(session, get_map(session, map_name).id, job_id, lock=True)
        if found.kind in MODEL_CHANGE_JOBS:
            cancel_model_change(session, found)
        elif found.kind == JobKind.BATCH:
            cancel_batch(session, found)
        else:
            cancel_job(found)
        session.flush()
        session.refresh(found)
        answer = JobResponse.of(found, map_name)
        idempotent.store_response(session, 200, answer)
        return answer

    return gateway.catalog.run(end)


@router.post(
    "/jobs/{job_id}/retry",
    operation_id="retry_job",
    response_model=JobResponse,
    dependencies=[WRITE, ADMIT_JOB],
)
def retry_job_by_id(
    gateway: GatewayDep, job_id: JobId, idempotent: IdempotentDep, map_name: MapName = DEFAULT_MAP
) -> JobResponse:
    """Queue a failed or cancelled job again; of a batch, the items that have failed."""
    with gateway.catalog.write() as session:
        found = get_job(session, get_map(session, map_name).id, job_id, lock=True)
        if found.kind == JobKind.BATCH:
            retry_batch(session, found)
        else:
            retry_job(session, found)
        session.flush()
        session.refresh(found)
        answer = JobResponse.of(found, map_name)
        idempotent.store_response(session, 200, answer)
    gateway.hints.send(queue_for_priority(found.priority))
    return answer


def _load_job_of_map(gateway: GatewayContext, map_name: str, job_id: UUID) -> Job:
    with gateway.catalog.read() as session:
        return get_job(session, get_map(session, map_name).id, job_id)


async def _events(
    gateway: GatewayContext, job_id: UUID, job: JobResponse, map_name: str
) -> AsyncIterator[str]:
    """The stream of a job that is now as `job` says."""
    number, last_seen, sent = 0, (), ""
    while True:
        if (text := job.model_dump_json()) != sent:
            sent, number = text, number + 1
            yield f"id: {number}\nevent: progress\ndata: {text}\n\n"
        if job.state not in UNFINISHED_STATES:
            return
        while True:
            try:
                change = await gateway.job_notifier.wait_for_change(
                    job_id, last_seen, HEARTBEAT_SECONDS
                )
                break
            except TimeoutError:
                yield ": still here\n\n"
            except SQLAlchemyError as error:
                if to_unavailable(error) is None:
                    raise
                yield ": the catalog is away\n\n"
                await asyncio.sleep(CATALOG_RETRY_SECONDS)
        if change is None:
            return
        job, last_seen = JobResponse.of(change.job, map_name), change.state
