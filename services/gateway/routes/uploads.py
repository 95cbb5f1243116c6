"""Route for uploading a photo: `POST /upload`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from sqlalchemy.orm import Session
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
from services.gateway.idempotency import IdempotentFormDep, delete_if_refused
from services.gateway.schemas import UploadResponse, accepted_headers, url_in_map
from services.gateway.uploads.multipart import multipart_schema, use_form_file
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.photos import PhotoRole
from shared.imaging.file_formats import ACCEPTED_PHOTOS, photo_suffix
from shared.ingest.store_photo import BeforeCommit, StoreResult, store_photo
from shared.ingest.validation import StoredUpload, check_photo_signature, validate_photo
from shared.jobs import Job, JobState
from shared.storage.keys import new_original_key

router = APIRouter(tags=["photos"])

_TEXT_SCHEMA = {"type": "string"}
UPLOAD_FORM = multipart_schema(
    ACCEPTED_PHOTOS,
    latitude={"type": "number", "minimum": -90, "maximum": 90},
    longitude={"type": "number", "minimum": -180, "maximum": 180},
    heading={"type": "number", "minimum": 0, "maximum": 360},
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

UPLOAD_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "model": UploadResponse,
        "description": "The map already has these bytes, and the photo is searchable.",
    },
    201: {"model": UploadResponse, "description": "Searchable (with `Prefer: wait=N`)."},
}


@router.post(
    "/upload",
    operation_id="upload",
    status_code=202,
    responses=UPLOAD_RESPONSES,
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

    Fields that the form leaves out are read from EXIF. The response is 202 with the job to poll;
    with `Prefer: wait=N`, 201 once the photo is searchable. If the map already has the same bytes,
    the existing photo is returned: with 200 if it is searchable, otherwise as if it had been sent
    for the first time (202 or 201). A failed or cancelled job is queued again.
    """
    key_id = get_caller(request).key_id
    quota = reserve_photo_quota(request, gateway.settings)

    def store_row(received: StoredUpload) -> tuple[StoreResult, str]:
        def store_response(session: Session, stored: StoreResult) -> StoreResult:
            outcome = UploadOutcome.of(stored, stored.job, received.key, query.map)
            idempotent.store_response(session, outcome.status, outcome.body, outcome.headers)
            return stored

        idempotent.claim_received(gateway.store, received)
        stored = _store_upload(gateway, query.map, received, key_id, quota, store_response)
        return stored, received.key

    with admission.admit_upload(UploadKind.UPLOAD, request):
        stored, key = await use_form_file(
            request,
            gateway.store,
            lambda filename: new_original_key(photo_suffix(filename)),
            gateway.settings.max_file_size,
            store_row,
            check_photo_signature,
        )

    def replace_response(outcome: UploadOutcome) -> None:
        idempotent.replace_response(outcome.status, outcome.body, outcome.headers)

    return await respond_to_upload(
        request, response, gateway, query.map, stored, key, replace_response
    )


@dataclass(frozen=True, slots=True)
class UploadOutcome:
    """Response to an upload."""

    status: int
    headers: dict[str, str]
    body: UploadResponse

    @classmethod
    def of(cls, stored: StoreResult, job: Job | None, key: str, map_name: str) -> UploadOutcome:
        """Build the response from the photo's job in its current state, if any.

        `key` is the object key of the received bytes.
        """
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
            already_there=stored.photo.object_key != key,
            message=_outcome_message(stored, job),
        )
        if stored.job is None or stored.job.state == JobState.SUCCEEDED:
            return cls(200, {"Location": status_url}, body)
        if body.status == JobState.SUCCEEDED:
            return cls(201, {"Location": status_url}, body)
        return cls(202, accepted_headers(status_url), body)


async def respond_to_upload(
    request: Request,
    response: Response,
    gateway: GatewayContext,
    map_name: str,
    stored: StoreResult,
    key: str,
    on_described: Callable[[UploadOutcome], None],
) -> UploadResponse:
    """Build the response to an upload, after waiting for its job if the request prefers it.

    `on_described` is called in a worker thread with the 201 response if the photo was described
    within the wait, to store it for repetitions of the request.
    """
    job = stored.job
    wait = parse_prefer_wait(request)
    if wait and job is not None and job.state != JobState.SUCCEEDED:
        response.headers["Preference-Applied"] = f"wait={wait:g}"
        job = await wait_for_job(gateway, job.id, wait) or job
    outcome = UploadOutcome.of(stored, job, key, map_name)
    if outcome.status == 201:
        await run_in_threadpool(on_described, outcome)
    response.status_code = outcome.status
    response.headers.update(outcome.headers)
    return outcome.body


def _store_upload(
    gateway: GatewayContext,
    map_name: str,
    received: StoredUpload,
    key_id: UUID | None,
    quota: AbstractContextManager[None],
    before_commit: BeforeCommit,
) -> StoreResult:
    """Validate and store the photo; delete the received bytes if they are not used."""
    with delete_if_refused(gateway.store, received.key):
        incoming = validate_photo(
            gateway.store, received, gateway.settings.max_image_pixels, key_id
        )
        with quota:
            stored = store_photo(
                gateway.catalog, gateway.wakeups, map_name, incoming, before_commit
            )
    if stored.photo.object_key != received.key:
        gateway.store.delete(received.key)
    return stored


def _outcome_message(stored: StoreResult, job: Job | None) -> str:
    beginning = "The photo is stored" if stored.queued else "The map already has this photo"
    if job is None or job.state == JobState.SUCCEEDED:
        return f"{beginning} and searchable." if stored.queued else f"{beginning}."
    reason = (job.error or {}).get("detail", "")
    if job.state not in UNFINISHED_STATES:
        return f"{beginning}, but its job is {job.state}. {reason}".strip()
    if job.waiting_for:
        return f"{beginning}. Its job is waiting for {job.waiting_for}."
    if reason:
        return f"{beginning}. Describing it failed and will be tried again: {reason}"
    return f"{beginning}. It is being described in the background."
