"""Route that brings a map up to date with a photo library, at once and on a schedule."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from services.gateway.admission import ADMIT_JOB
from services.gateway.authentication import WRITE
from services.gateway.dependencies import GatewayDep, MapQuery
from services.gateway.idempotency import IdempotentDep
from services.gateway.responses import JobAcceptedResponse
from shared.catalog.jobs import UNFINISHED_STATES, list_jobs
from shared.catalog.maps import get_map, lock_map
from shared.http.request_model import RequestModel
from shared.jobs import Job, JobKind
from shared.jobs.transitions import requeue_job_as_new

router = APIRouter(tags=["model changes"])


class LibrarySyncRequest(RequestModel):
    """When to repeat it."""

    every_hours: int | None = Field(
        None, ge=1, le=24 * 28, description="hours from the end of a run to the next; null: once"
    )


@router.post("/library-syncs", status_code=202, dependencies=[WRITE, ADMIT_JOB])
def sync_library(
    gateway: GatewayDep, idempotent: IdempotentDep, query: MapQuery, options: LibrarySyncRequest
) -> JobAcceptedResponse:
    """Bring the map up to date with the Immich library of the steward's environment.

    Nothing is written into the library. A map has one such job, which is queued again each time.
    Its `result` has the counts `with_coordinates`, `indexed`, `changed`, `removed`, `searchable`,
    `without_coordinates` and `located` (those with an accepted proposal), `failed` photos, and
    `every_hours`.
    """
    params = options.model_dump()
    with gateway.catalog.write() as session:
        map_ = lock_map(session, get_map(session, query.map).id)
        job = next(iter(list_jobs(session, map_.id, (), (JobKind.SYNC_LIBRARY,), 1, None)), None)
        if job is None:
            job = Job(map_id=map_.id, kind=JobKind.SYNC_LIBRARY, params=params)
        else:
            job.params = params
            if job.state not in UNFINISHED_STATES:
                requeue_job_as_new(job, keep_result=True)
        return idempotent.accept_job(session, job)
