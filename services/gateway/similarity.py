"""`POST /similarity` and `POST /similarity/{file_id}`: which known place is this?"""

from __future__ import annotations

import time
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import JSONResponse
from starlette.concurrency import run_in_threadpool

from services.gateway.compare import (
    check_closely,
    compare_described,
    compare_stored,
    compared_answer,
)
from services.gateway.context import (
    DEFAULT_MAP,
    FileId,
    Gateway,
    GatewayDep,
    JobId,
    MapName,
)
from services.gateway.find_similar import find_similar, query_by_job, query_by_photo
from services.gateway.key_check import READ
from services.gateway.once import Once, OnceFormDep
from services.gateway.receive import describe_form, receive_file
from services.gateway.room import ROOM_FOR_QUERIES, Kind, RoomDep
from services.gateway.schemas import JobStarted, SimilarityAnswer, started_job
from services.gateway.waiting import preferred_wait, wait_for_job
from services.gateway.wanted import Wanted, WantedDep
from shared.catalog.maps import get_map
from shared.comparison import query_expired
from shared.errors import (
    Conflict,
    Gone,
    NotFound,
    PlacewiseError,
    Unprocessable,
    invalid_field,
)
from shared.ids import new_id
from shared.intake.photo_header import read_photo_header
from shared.intake.received import Received, check_photo_begin
from shared.jobs import Job, JobKind, JobState, Priority
from shared.jobs.hints import Lane
from shared.jobs.table import QUERY_JOBS, UNFINISHED, get_job
from shared.objects.keys import query_key

router = APIRouter(tags=["similarity"])

BEING_COMPARED: dict[int | str, dict[str, Any]] = {
    202: {"model": JobStarted, "description": "Being compared; poll, then fetch."}
}
# Of a failed job's error; everything else is the photo's fault.
OF_STATUS = {kind.status: kind for kind in (NotFound, Conflict, Gone)}


@router.post(
    "/similarity/{file_id}",
    operation_id="similar_to_stored",
    response_model=SimilarityAnswer,
    responses=BEING_COMPARED,
    dependencies=[READ],
)
async def similar_to_stored(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    once: OnceFormDep,
    room: RoomDep,
    file_id: Annotated[FileId, PathParameter(description="a stored photo")],
    wanted: WantedDep,
    map_name: MapName = DEFAULT_MAP,
) -> Any:
    """The photos most similar to a stored one, without itself.

    With `rerank` or `explain` an extractor looks at them: 202 with a job where that takes longer
    than COMPARE_WAIT_SECONDS, or than N seconds with `Prefer: wait=N`. Poll `status_url`, then GET
    `result_url`.
    """

    def ask() -> SimilarityAnswer | Job:
        if not wanted.closely:
            return find_similar(gateway, query_by_photo(gateway, map_name, file_id), wanted)
        check_closely(gateway, map_name, wanted)
        room.take_query()
        once.begin(None, gateway.settings.query_ttl_seconds)
        return compare_stored(gateway, query_by_photo(gateway, map_name, file_id), wanted, once)

    asked = await run_in_threadpool(ask)
    if isinstance(asked, SimilarityAnswer):
        return asked
    settings = gateway.settings
    wait = preferred_wait(request, settings.max_wait_seconds) or settings.compare_wait_seconds
    return await _when_it_ends(gateway, response, asked, map_name, wait)


@router.post(
    "/similarity",
    operation_id="similar_to_upload",
    response_model=SimilarityAnswer,
    responses={202: {"model": JobStarted, "description": "Being described; poll, then fetch."}},
    openapi_extra=describe_form("the photo to ask with"),
    dependencies=[READ, ROOM_FOR_QUERIES],
)
async def similar_to_upload(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    once: OnceFormDep,
    room: RoomDep,
    wanted: WantedDep,
    map_name: MapName = DEFAULT_MAP,
) -> Any:
    """The photos most similar to one that is not stored.

    202 with a job: poll `status_url`, then GET `result_url`. With `Prefer: wait=N` the answer
    itself (200) when it takes no longer than N seconds. Repeated under an `Idempotency-Key`, it is
    answered with the 202 of its job.
    """
    await run_in_threadpool(check_closely, gateway, map_name, wanted)
    job_id = new_id()
    key = query_key(job_id)
    with room.receiving(Kind.QUERY, request):
        received = await receive_file(
            request, gateway.store, key, gateway.settings.max_file_size, check_photo_begin
        )
    await once.begin_form(gateway.store, received, life_seconds=gateway.settings.query_ttl_seconds)
    params = {"filename": received.filename, "wanted": wanted.model_dump(mode="json")}
    job = await run_in_threadpool(_queue, gateway, map_name, job_id, received, params, once)
    wait = preferred_wait(request, gateway.settings.max_wait_seconds)
    if wait:
        response.headers["Preference-Applied"] = f"wait={wait:g}"
    return await _when_it_ends(gateway, response, job, map_name, wait)


@router.get(
    "/jobs/{job_id}/result",
    operation_id="similarity_result",
    response_model=SimilarityAnswer,
    responses=BEING_COMPARED,
    dependencies=[READ],
)
async def similarity_result(
    response: Response, gateway: GatewayDep, job_id: JobId, map_name: MapName = DEFAULT_MAP
) -> Any:
    """The answer to a query whose job has succeeded; 409 before that.

    A query photo that is described and was asked with `rerank` or `explain` is now compared: 202
    with that job where it takes longer than COMPARE_WAIT_SECONDS.
    """

    def find() -> Job:
        with gateway.catalog.read() as session:
            return get_job(session, get_map(session, map_name).id, job_id)

    job = await run_in_threadpool(find)
    if job.kind not in QUERY_JOBS:
        raise Conflict("no_result", f"The job {job.id} ({job.kind}) has no similarity result.")
    if job.state in UNFINISHED:
        raise Conflict(
            "job_unfinished",
            f"The job {job.id} is {job.state}.",
            job_id=str(job.id),
            state=job.state,
        )
    wait = gateway.settings.compare_wait_seconds
    return await _when_it_ends(gateway, response, job, map_name, wait)


async def _when_it_ends(
    gateway: Gateway, response: Response, job: Job, map_name: str, wait_seconds: float
) -> SimilarityAnswer | JSONResponse:
    """What the query's job and the one that follows it come to within the time; else a 202."""
    deadline = time.monotonic() + wait_seconds
    while True:
        left = deadline - time.monotonic()
        if job.state in UNFINISHED and left > 0:
            waited = await wait_for_job(gateway, job.id, left)
            if waited is None:
                raise query_expired()
            job = waited
        if job.state in UNFINISHED:
            started = started_job(response, job, map_name)
            # As a response of its own: the route's model is that of the 200.
            return JSONResponse(started.model_dump(mode="json"), 202, dict(response.headers))
        result = await run_in_threadpool(_result, gateway, job, map_name)
        if isinstance(result, SimilarityAnswer):
            return result
        job = result


def _queue(
    gateway: Gateway,
    map_name: str,
    job_id: UUID,
    received: Received,
    params: dict[str, Any],
    once: Once,
) -> Job:
    try:
        check_photo_begin(received.begin)
        for name in received.fields:
            raise invalid_field(name, "is unknown here; filters belong into the address")
        with received.open(gateway.store) as file:
            read_photo_header(file, gateway.settings.max_image_pixels)
        with gateway.catalog.write() as session:
            job = Job(
                id=job_id,
                map_id=get_map(session, map_name).id,
                kind=JobKind.DESCRIBE,
                priority=Priority.QUERY,
                params=params,
            )
            session.add(job)
            session.flush()
            once.keep_job(session, job)
    except PlacewiseError:
        gateway.store.delete(received.key)
        raise
    gateway.hints.send(Lane.QUERY)
    return job


def _result(gateway: Gateway, job: Job, map_name: str) -> SimilarityAnswer | Job:
    """The answer of an ended job, or the job that goes on with it."""
    if job.state == JobState.SUCCEEDED:
        if job.kind == JobKind.COMPARE:
            return compared_answer(gateway, job, map_name)
        wanted = Wanted.model_validate(job.params["wanted"])
        query = query_by_job(gateway, job)
        if wanted.closely:
            return compare_described(gateway, job, query, wanted)
        return find_similar(gateway, query, wanted)
    if job.state == JobState.CANCELLED:
        raise Conflict("job_cancelled", f"The job {job.id} was cancelled.", job_id=str(job.id))
    error = job.error or {}
    kind = OF_STATUS.get(error.get("status", 0), Unprocessable)
    raise kind(
        error.get("code", "query_failed"),
        error.get("detail", "The photo could not be described."),
        job_id=str(job.id),
    )
