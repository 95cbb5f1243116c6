"""Routes of the similarity search: by stored photo, by uploaded photo, and results of jobs."""

from __future__ import annotations

from io import BytesIO
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as PathParameter
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import ADMIT_QUERY, AdmissionDep
from services.gateway.authentication import READ
from services.gateway.dependencies import (
    FileId,
    GatewayContext,
    GatewayDep,
    JobId,
    MapQuery,
    parse_prefer_wait,
    wait_for_job,
)
from services.gateway.idempotency import IdempotentFormDep, IdempotentRequest
from services.gateway.responses import JobAcceptedResponse
from services.gateway.similarity.execute import find_similar, query_from_job, query_from_photo
from services.gateway.similarity.geopose import GeoPoseRequest, GeoPoseResponse
from services.gateway.similarity.matches import check_matching_enabled
from services.gateway.similarity.search_params import SearchParams, SimilarityParams
from services.gateway.uploads.multipart import FormFile, multipart_schema
from services.gateway.uploads.query_photo import (
    describe_query_job,
    query_expired_error,
    query_job_search_params,
    receive_query_photo,
)
from shared.catalog.jobs import QUERY_TTL_SECONDS, UNFINISHED_STATES, get_job
from shared.catalog.maps import get_map
from shared.errors import Conflict, Gone, NotFound, Unavailable, Unprocessable, invalid_field_error
from shared.ids import new_id
from shared.imaging.photo_header import read_photo_header
from shared.ingest.validation import check_photo_signature
from shared.jobs import Job, JobKind, JobState
from shared.jobs.wakeups import JobMessage
from shared.responses.similarity import SimilarityResponse
from shared.storage.keys import query_key, query_preview_key

router = APIRouter(tags=["similarity"])

GEOPOSE_PATH = "/geopose"
GEOPOSE_WAIT_SECONDS = 30.0
"""Without `Prefer: wait=N`; its clients know no jobs"""

JOB_PENDING: dict[int | str, dict[str, Any]] = {
    202: {
        "model": JobAcceptedResponse,
        "description": "The job is queued. Poll it, then get its result.",
    }
}
# Exception class by the status of a failed job's error; other errors are due to the photo (422).
ERROR_BY_STATUS = {kind.status: kind for kind in (NotFound, Conflict, Gone)}


@router.post("/similarity/{file_id}", dependencies=[READ])
def similar_to_stored(
    gateway: GatewayDep,
    file_id: Annotated[FileId, PathParameter(description="a stored photo")],
    query: Annotated[SimilarityParams, Query()],
) -> SimilarityResponse:
    """Find the photos most similar to a stored photo, without that photo."""
    search_params = query.search_params()
    return find_similar(gateway, query_from_photo(gateway, query.map, file_id), search_params)


@router.post(
    "/similarity",
    response_model=SimilarityResponse,
    responses=JOB_PENDING,
    openapi_extra=multipart_schema("the query photo"),
    dependencies=[READ, ADMIT_QUERY],
)
async def similar_to_upload(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    idempotent: IdempotentFormDep,
    admission: AdmissionDep,
    query: Annotated[SimilarityParams, Query()],
) -> Any:
    """Find the photos most similar to an uploaded photo that is not stored.

    The response is 202 with a job: poll `status_url`, then GET `result_url`. With `Prefer: wait=N`
    it is 200 with the result if that takes at most N seconds. A request repeated with its
    `Idempotency-Key` gets the 202 of the first one.
    """
    search_params = query.search_params()
    async with receive_query_photo(request, gateway, admission) as (job_id, file):
        job = await run_in_threadpool(
            _queue_query, gateway, query.map, job_id, file, search_params, idempotent
        )
    wait = parse_prefer_wait(request)
    if wait:
        response.headers["Preference-Applied"] = f"wait={wait:g}"
        described = await wait_for_job(gateway, job.id, wait)
        if described is None:
            raise query_expired_error()
        job = described
    if job.state in UNFINISHED_STATES:
        return JobAcceptedResponse.of(job, query.map).to_http(response.headers)
    return await run_in_threadpool(_result_of, gateway, job)


@router.post(GEOPOSE_PATH, operation_id="geopose", dependencies=[READ, ADMIT_QUERY])
async def localise_by_geopose_protocol(
    request: Request, gateway: GatewayDep, sent: GeoPoseRequest, query: MapQuery
) -> GeoPoseResponse:
    """Localise a photo as the GeoPoseProtocol of the Open AR Cloud asks for it, version 1 or 2.

    The response has the pose as OGC GeoPose; 422 (`no_pose`) if there is none. 503
    (`query_unfinished`) if it takes more than 30 s, or those of `Prefer: wait=N`.
    """
    job = await run_in_threadpool(_queue_geopose, gateway, query.map, sent)
    wait = parse_prefer_wait(request) or GEOPOSE_WAIT_SECONDS
    described = await wait_for_job(gateway, job.id, wait)
    if described is None:
        raise query_expired_error()
    if described.state in UNFINISHED_STATES:
        raise Unavailable(
            "query_unfinished", f"The photo was not described within {wait:g} s. Send it again."
        )
    return GeoPoseResponse.of(sent, await run_in_threadpool(_result_of, gateway, described))


@router.get("/jobs/{job_id}/result", dependencies=[READ])
def similarity_result(gateway: GatewayDep, job_id: JobId, query: MapQuery) -> SimilarityResponse:
    """Get the result of a succeeded query job; 409 while it is unfinished."""
    with gateway.catalog.read() as session:
        job = get_job(session, get_map(session, query.map).id, job_id)
    if job.kind != JobKind.DESCRIBE:
        raise Conflict("no_result", f"The job {job.id} ({job.kind}) has no similarity result.")
    if job.state in UNFINISHED_STATES:
        raise Conflict(
            "job_unfinished",
            f"The job {job.id} is {job.state}.",
            job_id=str(job.id),
            state=job.state,
        )
    return _result_of(gateway, job)


@router.get(
    "/jobs/{job_id}/preview",
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}, "description": "the preview"}},
    dependencies=[READ],
)
def get_query_preview(gateway: GatewayDep, job_id: JobId, query: MapQuery) -> Response:
    """Get an uploaded query photo as browsers show it: an upright JPEG of at most 1,600 pixels.

    It exists once the photo is described, if the photo is a HEIC, TIFF or BMP file, until the query
    is deleted.
    """
    with gateway.catalog.read() as session:
        job = get_job(session, get_map(session, query.map).id, job_id)
    try:
        data = gateway.store.get(query_preview_key(job.id))
    except NotFound:
        raise NotFound(
            "preview_not_found",
            "The job has no preview: its photo is not described yet, or all browsers show its "
            "format.",
        ) from None
    return Response(data, media_type="image/jpeg", headers={"Cache-Control": "private, no-cache"})


def _queue_query(
    gateway: GatewayContext,
    map_name: str,
    job_id: UUID,
    file: FormFile,
    search_params: SearchParams,
    idempotent: IdempotentRequest,
) -> Job:
    upload = file.complete()
    with idempotent.begin_form(upload, QUERY_TTL_SECONDS):
        for name in upload.fields:
            raise invalid_field_error(name, "is unknown; send filters as query parameters")
        with upload.open(gateway.store) as photo:
            header = read_photo_header(photo, gateway.settings.max_image_pixels)
        with gateway.catalog.write() as session:
            map_ = get_map(session, map_name)
            check_matching_enabled(map_, search_params)
            job = describe_query_job(job_id, map_.id, upload.filename, search_params, header)
            idempotent.store_job_response(session, job)
    gateway.wakeups.send(JobMessage.of(job, map_name))
    return job


def _queue_geopose(gateway: GatewayContext, map_name: str, sent: GeoPoseRequest) -> Job:
    photo, job_id = sent.photo(), new_id()
    check_photo_signature(photo)
    header = read_photo_header(BytesIO(photo), gateway.settings.max_image_pixels)
    search_params = sent.search_params(header)
    gateway.store.put(query_key(job_id), photo)
    with gateway.catalog.write() as session:
        map_id = get_map(session, map_name).id
        job = describe_query_job(job_id, map_id, "geopose", search_params, header)
        session.add(job)
    gateway.wakeups.send(JobMessage.of(job, map_name))
    return job


def _result_of(gateway: GatewayContext, job: Job) -> SimilarityResponse:
    """The answer of a finished query job."""
    if job.state == JobState.SUCCEEDED:
        search_params = query_job_search_params(job)
        return find_similar(gateway, query_from_job(gateway, job), search_params)
    if job.state == JobState.CANCELLED:
        raise Conflict("job_cancelled", f"The job {job.id} was cancelled.", job_id=str(job.id))
    error = job.error or {}
    error_class = ERROR_BY_STATUS.get(error.get("status", 0), Unprocessable)
    raise error_class(
        error.get("code", "query_failed"),
        error.get("detail", "The photo could not be described."),
        job_id=str(job.id),
    )
