"""Route for uploading a photo: `POST /upload`."""

from __future__ import annotations

from dataclasses import dataclass

from fastapi import APIRouter, Request, Response
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import (
    ADMIT_JOB,
    CHECK_PHOTO_QUOTA,
    AdmissionDep,
    UploadKind,
    reserve_photo_quota,
)
from services.gateway.authentication import WRITE, get_caller
from services.gateway.dependencies import (
    GatewayContext,
    GatewayDep,
    MapQuery,
    parse_prefer_wait,
    wait_for_job,
)
from services.gateway.idempotency import IdempotentFormDep, IdempotentRequest
from services.gateway.responses import accepted_headers, url_in_map
from services.gateway.uploads.multipart import (
    MAX_FIELDS_BYTES,
    FormFile,
    multipart_schema,
    receive_form_file,
)
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.photos import PhotoRole
from shared.imaging.capture_place import MAX_ALTITUDE_M
from shared.imaging.file_formats import ACCEPTED_PHOTOS, photo_suffix
from shared.ingest.store_photo import StoreResult, insert_photo
from shared.ingest.validation import check_photo_signature, validate_photo
from shared.jobs import Job, JobState
from shared.jobs.wakeups import JobMessage
from shared.responses.jobs import UploadResponse
from shared.storage.keys import new_original_key

router = APIRouter(tags=["photos"])

_TEXT_SCHEMA = {"type": "string", "maxLength": MAX_FIELDS_BYTES}
UPLOAD_FORM = multipart_schema(
    ACCEPTED_PHOTOS,
    latitude={"type": "number", "minimum": -90, "maximum": 90},
    longitude={"type": "number", "minimum": -180, "maximum": 180},
    altitude={
        "type": "number",
        "minimum": -MAX_ALTITUDE_M,
        "maximum": MAX_ALTITUDE_M,
        "description": "metres",
    },
    heading={
        "type": "number",
        "minimum": 0,
        "maximum": 360,
        "description": "degrees clockwise from true north",
    },
    captured_at={"type": "string", "format": "date-time"},
    place={**_TEXT_SCHEMA, "description": "a label, for places without useful coordinates"},
    tags={**_TEXT_SCHEMA, "description": "separated by commas"},
    metadata={**_TEXT_SCHEMA, "description": "a JSON object"},
    relative_path={
        **_TEXT_SCHEMA,
        "description": "path in its folder or archive, such as Day 2/IMG_2078.jpg",
    },
    role={
        "type": "string",
        "enum": list(PhotoRole),
        "description": "`query`: a labelled query for evaluations, never returned by searches",
    },
)


@router.post(
    "/upload",
    operation_id="upload",
    status_code=202,
    responses={
        200: {
            "model": UploadResponse,
            "description": "The map already has these bytes, and the photo is searchable.",
        },
        201: {"model": UploadResponse, "description": "Searchable (with `Prefer: wait=N`)."},
    },
    openapi_extra=UPLOAD_FORM,
    dependencies=[WRITE, CHECK_PHOTO_QUOTA, ADMIT_JOB],
)
async def upload_photo(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    idempotent: IdempotentFormDep,
    admission: AdmissionDep,
    query: MapQuery,
) -> UploadResponse:
    """Store a photo and queue the job that describes it.

    Fields that the form leaves out are read from EXIF, or else from XMP in the file. The response
    is 202 with the job to poll; with `Prefer: wait=N`, 201 once the photo is searchable. If the map
    already has the same bytes, the existing photo is returned: with 200 if it is searchable,
    otherwise as if it had been sent for the first time (202 or 201). A failed or cancelled job is
    queued again. If the map has the same picture under the same path, in a file with other
    metadata, the photo's file is replaced, and its coordinates, altitude, heading and time are
    those of the new file, as far as it has some (`updated`).
    """
    with admission.admit_upload(UploadKind.UPLOAD, request):
        async with receive_form_file(
            request,
            gateway.store,
            lambda filename: new_original_key(photo_suffix(filename)),
            gateway.settings.max_file_size,
            check_photo_signature,
        ) as file:
            stored = await run_in_threadpool(
                _store_upload, request, gateway, query.map, file, idempotent
            )
    job = await _wait_for_description(request, response, gateway, stored)
    outcome = UploadOutcome.of(stored, job, query.map)
    response.status_code = outcome.status
    response.headers.update(outcome.headers)
    return outcome.body


@dataclass(frozen=True, slots=True)
class UploadOutcome:
    """Response to an upload."""

    status: int
    headers: dict[str, str]
    body: UploadResponse

    @classmethod
    def of(cls, stored: StoreResult, job: Job | None, map_name: str) -> UploadOutcome:
        """Build the response from the photo's job in its current state, if any."""
        status_url = url_in_map(
            f"/jobs/{job.id}" if job else f"/uploads/{stored.photo.id}", map_name
        )
        body = UploadResponse(
            file_id=stored.photo.id,
            job_id=job.id if job else None,
            filename=stored.photo.filename,
            file_size=stored.photo.size_bytes,
            upload_time=stored.photo.uploaded_at,
            status=JobState(job.state) if job else JobState.SUCCEEDED,
            status_url=status_url,
            already_there=stored.already_there,
            updated=list(stored.updated),
            message=_outcome_message(stored, job),
        )
        if stored.job is None or stored.job.state == JobState.SUCCEEDED:
            return cls(200, {"Location": status_url}, body)
        if body.status == JobState.SUCCEEDED:
            return cls(201, {"Location": status_url}, body)
        return cls(202, accepted_headers(status_url), body)


async def _wait_for_description(
    request: Request, response: Response, gateway: GatewayContext, stored: StoreResult
) -> Job | None:
    """Return the photo's job, after waiting for its end as long as `Prefer: wait=N` allows."""
    job, wait = stored.job, parse_prefer_wait(request)
    if not wait or job is None or job.state == JobState.SUCCEEDED:
        return job
    response.headers["Preference-Applied"] = f"wait={wait:g}"
    return await wait_for_job(gateway, job.id, wait) or job


def _store_upload(
    request: Request,
    gateway: GatewayContext,
    map_name: str,
    file: FormFile,
    idempotent: IdempotentRequest,
) -> StoreResult:
    """Validate the photo, and store its row, its job and the response in one transaction."""
    upload = file.complete()
    with idempotent.begin_form(upload):
        photo = validate_photo(
            gateway.store, upload, gateway.settings.max_image_pixels, get_caller(request).key_id
        )
        with reserve_photo_quota(request, gateway.settings), gateway.catalog.write() as session:
            stored = insert_photo(session, map_name, photo)
            outcome = UploadOutcome.of(stored, stored.job, map_name)
            idempotent.store_response(session, outcome.status, outcome.body, outcome.headers)
    if stored.queued and stored.job is not None:
        gateway.wakeups.send(JobMessage.of(stored.job, map_name, stored.photo.filename))
    if stored.unused_key is not None:
        gateway.store.delete(stored.unused_key)
    return stored


def _outcome_message(stored: StoreResult, job: Job | None) -> str:
    beginning = "The photo is stored" if stored.queued else "The map already has this photo"
    if stored.updated:
        names = ", ".join(stored.updated)
        beginning = f"The map already has this photo; updated by its new metadata: {names}"
    if job is None or job.state == JobState.SUCCEEDED:
        return f"{beginning} and searchable." if stored.queued else f"{beginning}."
    reason = (job.error or {}).get("detail", "")
    if job.state not in UNFINISHED_STATES:
        return f"{beginning}, but its job is {job.state}. {reason}".strip()
    if reason:
        return f"{beginning}. Describing it failed and will be tried again: {reason}"
    return f"{beginning}. It is being described in the background."
