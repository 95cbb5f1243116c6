"""Routes of presigned uploads: clients send photos directly to the bucket.

```
POST /uploads/presign ─> URL ─> PUT the bytes to incoming/<upload id> ─> POST .../complete
                                                                            │
    originals/<key>  <─ copied within the bucket, then validated ───────────┘
```
The URL can be used until it expires, so the object in `incoming/` may change at any time. Only the
copy is validated, described and acknowledged.
"""

from __future__ import annotations

import contextlib
from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from pydantic import Field
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
    NO_NUL_PATTERN,
    GatewayContext,
    GatewayDep,
    MapQuery,
    UploadId,
)
from services.gateway.idempotency import IdempotentDep, IdempotentRequest, delete_if_refused
from services.gateway.responses import url_in_map
from services.gateway.routes.photos import PhotoUpdate
from services.gateway.routes.uploads import (
    UPLOAD_RESPONSES,
    UploadOutcome,
    finish_upload,
    wait_for_description,
)
from shared.catalog.database.base import db_now_plus
from shared.catalog.maps import get_map
from shared.catalog.photos import PresignedUpload, get_presigned_upload
from shared.errors import Conflict, NotFound, PlacewiseError, Unavailable, Unprocessable
from shared.ids import new_id
from shared.ingest.photo_metadata import PhotoFields, coordinate_pair
from shared.ingest.store_photo import StoreResult, insert_photo
from shared.ingest.validation import (
    StoredUpload,
    ValidatedPhoto,
    base_name,
    file_too_large_error,
    validate_photo,
)
from shared.responses import ResponseModel
from shared.responses.jobs import UploadResponse
from shared.storage import ObjectInfo, PresigningStore
from shared.storage.keys import incoming_key, new_original_key

router = APIRouter(tags=["photos"])

PRESIGN_SECONDS = 900  # to send and complete an upload: 100 MB at 1 Mbit/s
FILE_FIELDS = ("filename", "file_size", "sha256")


class PresignRequest(PhotoUpdate):
    """The file to be sent, and the photo fields of `POST /upload`."""

    filename: str = Field(min_length=1, max_length=255, pattern=NO_NUL_PATTERN)
    file_size: int = Field(gt=0, le=2**62, description="size in bytes")
    sha256: str = Field(pattern="^[0-9a-f]{64}$", description="SHA-256 of the file, hexadecimal")

    def photo_fields(self) -> dict[str, Any]:
        """Return the fields of the photo, without those of the file, as JSON values."""
        return self.model_dump(mode="json", exclude=set(FILE_FIELDS), exclude_none=True)


class PresignResponse(ResponseModel):
    """PUT the bytes to `url` with exactly these `headers`, then POST to `complete_url`."""

    upload_id: UUID
    method: str
    url: str
    headers: dict[str, str]
    complete_url: str
    expires_at: datetime


@router.post(
    "/uploads/presign",
    operation_id="presign_upload",
    status_code=201,
    dependencies=[WRITE, CHECK_PHOTO_QUOTA, ADMIT_JOB],
)
def create_presigned_upload(
    gateway: GatewayDep,
    body: PresignRequest,
    idempotent: IdempotentDep,
    query: MapQuery,
) -> PresignResponse:
    """Create a presigned URL for uploading a photo directly to the bucket.

    This requires a server that stores its objects in a bucket (S3_ENDPOINT). The photo is stored
    when the upload is completed.
    """
    store = _require_presigning_store(gateway)
    limit = gateway.settings.max_file_size
    if body.file_size > limit:
        raise file_too_large_error(limit)
    fields = body.photo_fields()
    _parse_photo_fields(fields)  # refuses invalid fields before the file is sent
    upload_id = new_id()
    put = store.presign_put(
        incoming_key(upload_id),
        size_bytes=body.file_size,
        sha256=body.sha256,
        expires_seconds=PRESIGN_SECONDS,
    )
    with gateway.catalog.write() as session:
        upload = PresignedUpload(
            id=upload_id,
            map_id=get_map(session, query.map).id,
            filename=base_name(body.filename),
            size_bytes=body.file_size,
            sha256=body.sha256,
            photo_fields=fields,
            expires_at=db_now_plus(PRESIGN_SECONDS),
        )
        session.add(upload)
        session.flush()
        response = PresignResponse(
            upload_id=upload_id,
            method="PUT",
            url=put.url,
            headers=put.headers,
            complete_url=url_in_map(f"/uploads/presign/{upload_id}/complete", query.map),
            expires_at=upload.expires_at,
        )
        idempotent.store_response(session, 201, response)
    return response


@router.post(
    "/uploads/presign/{upload_id}/complete",
    operation_id="complete_upload",
    status_code=202,
    responses=UPLOAD_RESPONSES,
    dependencies=[WRITE, CHECK_PHOTO_QUOTA, ADMIT_JOB],
)
async def complete_presigned_upload(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    admission: AdmissionDep,
    upload_id: Annotated[
        UploadId, PathParameter(description="from the response of `POST /uploads/presign`")
    ],
    query: MapQuery,
) -> UploadResponse:
    """Complete a presigned upload: validate the sent file and store the photo.

    The responses are those of `POST /upload`. A repeated request gets the job of the first one.
    """
    # Executed once, as a request with an Idempotency-Key is.
    idempotent = IdempotentRequest(gateway, request, response, f"upload-{upload_id}")
    with admission.admit_upload(UploadKind.UPLOAD, request):
        stored = await run_in_threadpool(
            _complete_upload, request, gateway, query.map, upload_id, idempotent
        )
    job = await wait_for_description(request, response, gateway, stored)
    return UploadOutcome.of(stored, job, query.map).send(response)


def _complete_upload(
    request: Request,
    gateway: GatewayContext,
    map_name: str,
    upload_id: UUID,
    idempotent: IdempotentRequest,
) -> StoreResult:
    """Copy the object, validate the copy and store the photo, unless that was done before."""
    store = _require_presigning_store(gateway)
    idempotent.begin(None)
    try:
        stored = _store_copy(request, gateway, store, map_name, upload_id, idempotent)
    except PlacewiseError:
        idempotent.replay_if_executed()  # by a request at the same time
        raise
    finish_upload(gateway, stored, map_name)
    # The photo is acknowledged already; garbage collection deletes the object if this fails.
    with contextlib.suppress(Unavailable):
        store.delete(incoming_key(upload_id))
    return stored


def _store_copy(
    request: Request,
    gateway: GatewayContext,
    store: PresigningStore,
    map_name: str,
    upload_id: UUID,
    idempotent: IdempotentRequest,
) -> StoreResult:
    with gateway.catalog.read() as session:
        upload = get_presigned_upload(session, get_map(session, map_name).id, upload_id)
    source_key, key = incoming_key(upload_id), new_original_key()
    try:
        _check_object_size(store.head(source_key), upload)
        store.copy(source_key, key)
    except NotFound:
        raise Conflict(
            "upload_incomplete",
            f"No file was sent for the upload {upload.id} yet. PUT it to the URL of the upload "
            "first.",
        ) from None
    with delete_if_refused(store, key):
        photo = _validate_copy(request, gateway, store, key, upload)
        with reserve_photo_quota(request, gateway.settings), gateway.catalog.write() as session:
            stored = insert_photo(session, map_name, photo)
            session.delete(get_presigned_upload(session, upload.map_id, upload_id, lock=True))
            outcome = UploadOutcome.of(stored, stored.job, map_name)
            idempotent.store_response(session, outcome.status, outcome.body, outcome.headers)
    return stored


def _validate_copy(
    request: Request,
    gateway: GatewayContext,
    store: PresigningStore,
    key: str,
    upload: PresignedUpload,
) -> ValidatedPhoto:
    """Validate the copied object; Unprocessable (`size_differs`, `sha256_differs`)."""
    _check_object_size(store.head(key), upload)
    received = StoredUpload.read(store, key, upload.filename)
    if received.sha256 != upload.sha256:
        raise Unprocessable(
            "sha256_differs",
            f"The file that was sent has the SHA-256 {received.sha256}, not {upload.sha256}. "
            "Send the announced file again to the same URL, or start a new upload.",
        )
    return validate_photo(
        store,
        received,
        gateway.settings.max_image_pixels,
        get_caller(request).key_id,
        _parse_photo_fields(upload.photo_fields),
    )


def _check_object_size(info: ObjectInfo | None, upload: PresignedUpload) -> None:
    """Raise NotFound if there is no object, and Unprocessable (`size_differs`)."""
    if info is None:
        raise NotFound("object_not_found", "No file was sent.")
    if info.size_bytes != upload.size_bytes:
        raise Unprocessable(
            "size_differs",
            f"The file that was sent has {info.size_bytes} bytes, not {upload.size_bytes}. Send "
            "the announced file again to the same URL, or start a new upload.",
        )


def _parse_photo_fields(values: dict[str, Any]) -> PhotoFields:
    columns = PhotoUpdate.model_validate(values).to_columns()
    if "attributes" in columns:
        columns["metadata"] = columns.pop("attributes")
    columns["latitude"], columns["longitude"] = coordinate_pair(
        columns.get("latitude"), columns.get("longitude")
    )
    return PhotoFields(**columns)


def _require_presigning_store(gateway: GatewayContext) -> PresigningStore:
    if isinstance(gateway.store, PresigningStore):
        return gateway.store
    raise Conflict(
        "no_direct_uploads",
        "Presigned uploads need a bucket (S3_ENDPOINT), but this server stores its photos in a "
        "folder. Use POST /api/v1/upload.",
    )
