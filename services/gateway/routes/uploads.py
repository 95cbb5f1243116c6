"""`POST /upload`: one photo in."""

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
    DEFAULT_MAP,
    GatewayContext,
    GatewayDep,
    MapName,
    parse_prefer_wait,
    wait_for_job,
)
from services.gateway.idempotency import IdempotentFormDep
from services.gateway.multipart_upload import multipart_schema, store_form_file
from services.gateway.schemas import UploadResponse, url_in_map
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.photos import PhotoRole
from shared.errors import PlacewiseError
from shared.imaging.file_formats import ACCEPTED_PHOTOS
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
    place={**_TEXT_SCHEMA, "description": "a label, where coordinates say little"},
    tags={**_TEXT_SCHEMA, "description": "separated by commas"},
    metadata={**_TEXT_SCHEMA, "description": "a JSON object"},
    role={
        "type": "string",
        "enum": list(PhotoRole),
        "description": "`query`: a labelled query, never found; evaluations ask with it",
    },
)

UPLOAD_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"model": UploadResponse, "description": "The map has these bytes already."},
    201: {"model": UploadResponse, "description": "Searchable (with `Prefer: wait=N`)."},
}


@router.post(
    "/upload",
    operation_id="upload",
    status_code=202,
    response_model=UploadResponse,
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
    map_name: MapName = DEFAULT_MAP,
) -> UploadResponse:
    """Store a photo and queue its description. EXIF fills what the form leaves out.

    202 with the job to poll; with `Prefer: wait=N`, 201 once the photo is searchable. The same
    bytes again give the existing photo (200), or queue it again after a failed job (202).
    """
    with admission.admit_upload(UploadKind.UPLOAD, request):
        received = await store_form_file(
            request,
            gateway.store,
            new_original_key(),
            gateway.settings.max_file_size,
            check_photo_signature,
        )
    await idempotent.claim_form(gateway.store, received)

    def keep(session: Session, stored: StoreResult) -> StoreResult:
        said = UploadOutcome.of(stored, stored.job, received.key, map_name)
        idempotent.store_response(session, said.status, said.body, said.headers)
        return stored

    key_id = get_caller(request).key_id
    place = reserve_photo_quota(request, gateway.settings)
    stored = await run_in_threadpool(
        _store_upload, gateway, map_name, received, key_id, place, keep
    )

    def replace(said: UploadOutcome) -> None:
        idempotent.replace_response(said.status, said.body, said.headers)

    return await respond_to_upload(
        request, response, gateway, map_name, stored, received.key, replace
    )


@dataclass(frozen=True, slots=True)
class UploadOutcome:
    """What an upload is answered."""

    status: int
    headers: dict[str, str]
    body: UploadResponse

    @classmethod
    def of(cls, stored: StoreResult, job: Job | None, key: str, map_name: str) -> UploadOutcome:
        """`job` as it is now, and the `key` of the bytes that came."""
        status_url = url_in_map(
            f"/jobs/{job.id}" if job else f"/uploads/{stored.photo.id}", map_name
        )
        answer = UploadResponse(
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
        if not stored.queued or job is None:
            return cls(200, {"Location": status_url}, answer)
        if job.state == JobState.SUCCEEDED:
            return cls(201, {"Location": status_url}, answer)
        return cls(202, {"Location": status_url, "Retry-After": "1"}, answer)


async def respond_to_upload(
    request: Request,
    response: Response,
    gateway: GatewayContext,
    map_name: str,
    stored: StoreResult,
    key: str,
    on_described: Callable[[UploadOutcome], None],
) -> UploadResponse:
    """What is answered to an upload that was kept, after the wait that the request prefers.

    `key` is that of the bytes that came; `on_described` is told when the photo was described
    meanwhile,
    to answer so again.
    """
    job = stored.job
    wait = parse_prefer_wait(request, gateway.settings.max_wait_seconds)
    if wait and stored.queued and job is not None:
        response.headers["Preference-Applied"] = f"wait={wait:g}"
        job = await wait_for_job(gateway, job.id, wait)
    said = UploadOutcome.of(stored, job, key, map_name)
    if said.status == 201:
        await run_in_threadpool(on_described, said)
    response.status_code = said.status
    response.headers.update(said.headers)
    return said.body


def _store_upload(
    gateway: GatewayContext,
    map_name: str,
    received: StoredUpload,
    key_id: UUID | None,
    place: AbstractContextManager[None],
    keep: BeforeCommit,
) -> StoreResult:
    """Check what came and acknowledge it; whatever is not kept leaves no bytes behind."""
    try:
        incoming = validate_photo(
            gateway.store, received, gateway.settings.max_image_pixels, key_id
        )
        with place:
            stored = store_photo(gateway.catalog, gateway.hints, map_name, incoming, keep)
    except PlacewiseError:
        # Only what is certainly refused: after a lost connection the row may be committed.
        gateway.store.delete(received.key)
        raise
    if stored.photo.object_key != received.key:
        gateway.store.delete(received.key)
    return stored


def _outcome_message(stored: StoreResult, job: Job | None) -> str:
    if not stored.queued:
        return "The map has this photo already."
    if job is None or job.state in UNFINISHED_STATES:
        return "Stored; it is described in the background."
    if job.state == JobState.SUCCEEDED:
        return "Stored and searchable."
    reason = (job.error or {}).get("detail", "")
    return f"Stored, but its job is {job.state}. {reason}".strip()
