"""Routes of `/jobs`: status, long polling, cancel and retry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Query
from pydantic import Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import ADMIT_JOB
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import (
    MAX_WAIT_SECONDS,
    GatewayContext,
    GatewayDep,
    JobId,
    MapPageParams,
    MapParams,
    MapQuery,
    load_job_of_map,
    wait_for_job,
)
from services.gateway.idempotency import IdempotentDep
from services.gateway.responses import JobResponse, JobsResponse
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES, get_job, list_jobs
from shared.catalog.maps import get_map
from shared.jobs import Job, JobKind, JobState
from shared.jobs.model_changes import cancel_model_change
from shared.jobs.transitions import cancel_batch, cancel_job, retry_batch, retry_job
from shared.jobs.wakeups import read_job_messages, report_jobs

router = APIRouter(tags=["jobs"])


class JobsParams(MapPageParams):
    state: list[JobState] | None = Field(None, max_length=len(JobState))
    kind: list[JobKind] | None = Field(None, max_length=len(JobKind))


@router.get("/jobs", operation_id="list_jobs", dependencies=[READ])
def read_jobs(gateway: GatewayDep, query: Annotated[JobsParams, Query()]) -> JobsResponse:
    """List jobs, newest first. `reindex` jobs of a running model change need `kind=reindex`."""
    before = query.before
    with gateway.catalog.read() as session:
        map_id = get_map(session, query.map).id
        jobs = list_jobs(
            session, map_id, query.state or [], query.kind or [], query.limit + 1, before
        )
        names = _read_filenames(session, jobs)
    page, next_cursor = query.split(jobs)
    responses = [JobResponse.of(job, query.map, names.get(job.id)) for job in page]
    return JobsResponse(jobs=responses, next_cursor=next_cursor)


class JobStatusParams(MapParams):
    wait: float = Field(0.0, ge=0, description="seconds to wait for the end of the job")


@router.get("/jobs/{job_id}", operation_id="get_job", dependencies=[READ])
async def read_job_status(
    gateway: GatewayDep, job_id: JobId, query: Annotated[JobStatusParams, Query()]
) -> JobResponse:
    """Get one job. `?wait=20` waits up to 20 seconds for its end (long polling)."""
    job = await run_in_threadpool(load_job_of_map, gateway, query.map, job_id)
    if query.wait and job.state in UNFINISHED_STATES:
        seconds = min(query.wait, MAX_WAIT_SECONDS)
        job = await wait_for_job(gateway, job_id, seconds) or job
    return await run_in_threadpool(_job_response, gateway, job, query.map)


def _read_filenames(session: Session, jobs: Sequence[Job]) -> dict[UUID, str | None]:
    """Return the name of each job's photo or uploaded file."""
    ids = [job.id for job in jobs]
    return {message.id: message.file for message in read_job_messages(session, ids)}


def _job_response(gateway: GatewayContext, job: Job, map_name: str) -> JobResponse:
    with gateway.catalog.read() as session:
        return JobResponse.of(job, map_name, _read_filenames(session, [job]).get(job.id))


@router.post("/jobs/{job_id}/cancel", operation_id="cancel_job", dependencies=[WRITE])
def cancel_job_by_id(
    gateway: GatewayDep, job_id: JobId, idempotent: IdempotentDep, query: MapQuery
) -> JobResponse:
    """Cancel a job immediately. Results that a worker is still computing are discarded."""

    def cancel(session: Session) -> JobResponse:
        job = get_job(session, get_map(session, query.map).id, job_id, lock=True)
        if job.kind in MODEL_CHANGE_JOBS:
            cancel_model_change(session, job)
        elif job.kind == JobKind.BATCH:
            cancel_batch(session, job)
        else:
            cancel_job(job)
        session.flush()
        session.refresh(job)
        response = JobResponse.of(job, query.map, _read_filenames(session, [job]).get(job.id))
        idempotent.store_response(session, 200, response)
        return response

    response = gateway.catalog.run(cancel)
    report_jobs(gateway.catalog, gateway.wakeups, [job_id])
    return response


@router.post("/jobs/{job_id}/retry", operation_id="retry_job", dependencies=[WRITE, ADMIT_JOB])
def retry_job_by_id(
    gateway: GatewayDep, job_id: JobId, idempotent: IdempotentDep, query: MapQuery
) -> JobResponse:
    """Queue a failed or cancelled job again; for a batch, only its failed items."""
    with gateway.catalog.write() as session:
        job = get_job(session, get_map(session, query.map).id, job_id, lock=True)
        if job.kind == JobKind.BATCH:
            retry_batch(session, job)
        else:
            retry_job(session, job)
        session.flush()
        session.refresh(job)
        response = JobResponse.of(job, query.map, _read_filenames(session, [job]).get(job.id))
        idempotent.store_response(session, 200, response)
        messages = read_job_messages(session, [job.id])
    report_jobs(gateway.catalog, gateway.wakeups, [job.id])
    gateway.wakeups.send(*messages)
    return response
