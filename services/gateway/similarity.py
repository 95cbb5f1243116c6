"""`POST /similarity` and `POST /similarity/{file_id}`: which known place is this?"""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import JSONResponse
from starlette.concurrency import run_in_threadpool

from services.gateway.context import (
    DEFAULT_MAP,
    FileId,
    Gateway,
    GatewayDep,
    JobId,
    MapName,
    MinScore,
    TopK,
    WordWeightsWanted,
)
from services.gateway.filters import FilterDep
from services.gateway.find_similar import Wanted, find_similar, query_by_job, query_by_photo
from services.gateway.once import Once, OnceFormDep
from services.gateway.receive import describe_form, receive_file
from services.gateway.room import ROOM_FOR_QUERIES, Kind, RoomDep
from services.gateway.schemas import JobStarted, SimilarityAnswer, job_started
from services.gateway.waiting import preferred_wait, wait_for_job
from shared.catalog.maps import get_map
from shared.errors import Conflict, Gone, PlacewiseError, Unprocessable, invalid_field
from shared.ids import new_id
from shared.intake.photo_header import read_photo_header
from shared.intake.received import Received, check_photo_begin
from shared.jobs import Job, JobKind, JobState, Priority
from shared.jobs.hints import Lane
from shared.jobs.table import UNFINISHED, get_job
from shared.objects.keys import query_key

router = APIRouter(tags=["similarity"])


@router.post(
    "/similarity/{file_id}",
    operation_id="similar_to_stored",
    response_model=SimilarityAnswer,
)
def similar_to_stored(
    gateway: GatewayDep,
    file_id: Annotated[FileId, PathParameter(description="a stored photo")],
    photos: FilterDep,
    top_k: TopK = 10,
    min_score: MinScore = None,
    word_weights: WordWeightsWanted = True,
    map_name: MapName = DEFAULT_MAP,
) -> SimilarityAnswer:
    """The photos most similar to a stored one, without itself."""
    wanted = Wanted(top_k=top_k, min_score=min_score, photos=photos, word_weights=word_weights)
    return find_similar(gateway, query_by_photo(gateway, map_name, file_id), wanted)


@router.post(
    "/similarity",
    operation_id="similar_to_upload",
    response_model=SimilarityAnswer,
    responses={202: {"model": JobStarted, "description": "Being described; poll, then fetch."}},
    openapi_extra=describe_form("the photo to ask with"),
    dependencies=[ROOM_FOR_QUERIES],
)
async def similar_to_upload(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    once: OnceFormDep,
    room: RoomDep,
    photos: FilterDep,
    top_k: TopK = 10,
    min_score: MinScore = None,
    word_weights: WordWeightsWanted = True,
    map_name: MapName = DEFAULT_MAP,
) -> Any:
    """The photos most similar to one that is not stored.

    202 with a job: poll `status_url`, then GET `result_url`. With `Prefer: wait=N` the answer
    itself (200) when it takes no longer than N seconds. Repeated under an `Idempotency-Key`, it is
    answered with the 202 of its job.
    """
    job_id = new_id()
    key = query_key(job_id)
    with room.receiving(Kind.QUERY):
        received = await receive_file(
            request, gateway.store, key, gateway.settings.max_file_size, check_photo_begin
        )
    await once.begin_form(gateway.store, received, life_seconds=gateway.settings.query_ttl_seconds)
    wanted = Wanted(top_k=top_k, min_score=min_score, photos=photos, word_weights=word_weights)
    params = {"filename": received.filename, "wanted": wanted.model_dump(mode="json")}
    job: Job | None = await run_in_threadpool(
        _queue, gateway, map_name, job_id, received, params, once
    )
    wait = preferred_wait(request, gateway.settings.max_wait_seconds)
    if wait:
        response.headers["Preference-Applied"] = f"wait={wait:g}"
        job = await wait_for_job(gateway, job_id, wait)
    if job is None:
        raise _expired()
    if job.state in UNFINISHED:
        started = job_started(job)
        response.headers["Location"] = started.status_url
        response.headers["Retry-After"] = "1"
        # As a response of its own: the route's model is that of the 200.
        return JSONResponse(started.model_dump(mode="json"), 202, dict(response.headers))
    return await run_in_threadpool(_result, gateway, job)


@router.get(
    "/jobs/{job_id}/result",
    operation_id="similarity_result",
    response_model=SimilarityAnswer,
)
def similarity_result(
    gateway: GatewayDep, job_id: JobId, map_name: MapName = DEFAULT_MAP
) -> SimilarityAnswer:
    """The answer to a query photo whose job has succeeded; 409 before that."""
    with gateway.catalog.read() as session:
        job = get_job(session, get_map(session, map_name).id, job_id)
    if job.kind != JobKind.DESCRIBE:
        raise Conflict("no_result", f"The job {job.id} ({job.kind}) has no similarity result.")
    if job.state in UNFINISHED:
        raise Conflict(
            "job_unfinished",
            f"The job {job.id} is {job.state}.",
            job_id=str(job.id),
            state=job.state,
        )
    return _result(gateway, job)


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


def _result(gateway: Gateway, job: Job) -> SimilarityAnswer:
    if job.state == JobState.SUCCEEDED:
        wanted = Wanted.model_validate(job.params["wanted"])
        return find_similar(gateway, query_by_job(gateway, job), wanted)
    if job.state == JobState.CANCELLED:
        raise Conflict("job_cancelled", f"The job {job.id} was cancelled.", job_id=str(job.id))
    error = job.error or {}
    kind = Conflict if error.get("status") == Conflict.status else Unprocessable
    raise kind(
        error.get("code", "query_failed"),
        error.get("detail", "The photo could not be described."),
        job_id=str(job.id),
    )


def _expired() -> Gone:
    return Gone("query_expired", "The query is no longer kept (QUERY_TTL_SECONDS). Ask again.")
