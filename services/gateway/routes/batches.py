"""Routes of batch uploads: `POST /upload/batch` and `GET /jobs/{job_id}/items`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import (
    ADMIT_JOB,
    CHECK_PHOTO_QUOTA,
    AdmissionDep,
    UploadKind,
    get_photo_limit,
)
from services.gateway.authentication import READ, WRITE, Caller, get_caller
from services.gateway.dependencies import (
    GatewayContext,
    GatewayDep,
    JobId,
    MapPageParams,
    MapQuery,
    invalid_cursor_error,
)
from services.gateway.idempotency import IdempotentFormDep, IdempotentReplay, IdempotentRequest
from services.gateway.responses import JobAcceptedResponse, job_url
from services.gateway.uploads.batch import (
    FILES_FIELD,
    MANIFEST_FIELD,
    MAX_PREFIX_BYTES,
    PREFIX_FIELD,
    BatchFile,
    BatchUpload,
    discard_batch_upload,
    parse_batch_upload,
    too_many_photos_error,
)
from shared.catalog.batch_items import BatchSource, add_batch_items, create_batch, list_batch_items
from shared.catalog.jobs import get_job
from shared.catalog.maps import get_map
from shared.config.gateway_settings import MAX_BATCH_PHOTOS
from shared.config.settings import Settings
from shared.errors import Conflict, PlacewiseError, Unprocessable, invalid_field_error
from shared.ingest.photo_metadata import (
    KEY_FIELD,
    MAX_MANIFEST_BYTES,
    MAX_REPORTED_LINES,
    ManifestEntry,
    bad_lines_error,
    read_jsonl_manifest,
)
from shared.jobs import JobKind, JobState
from shared.responses import ResponseModel
from shared.responses.jobs import BatchItemResponse
from shared.storage.keys import IMPORTS, is_valid_key

router = APIRouter(tags=["batches"])

REQUEST_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {
                        FILES_FIELD: {
                            "type": "array",
                            "maxItems": MAX_BATCH_PHOTOS,
                            "items": {"type": "string", "format": "binary"},
                            "description": "photos",
                        },
                        MANIFEST_FIELD: {
                            "type": "string",
                            "maxLength": MAX_MANIFEST_BYTES,
                            "description": "JSON lines: `filename` (of a file of the form) or "
                            "`key` (of an object below `imports/`), and any of the fields of "
                            "`POST /upload`",
                        },
                        PREFIX_FIELD: {
                            "type": "string",
                            "maxLength": MAX_PREFIX_BYTES,
                            "description": "imports all photos below this key prefix, which must "
                            "be below `imports/`; also accepted as s3://S3_BUCKET/...",
                        },
                    },
                }
            },
        },
    }
}


class BatchAcceptedResponse(JobAcceptedResponse):
    """202: poll `status_url`; `items_url` lists the photos."""

    items_url: str


class BatchItemsResponse(ResponseModel):
    items: list[BatchItemResponse]
    next_cursor: str | None


class BatchItemsParams(MapPageParams):
    limit: int = Field(100, ge=1, le=1000)
    state: list[JobState] | None = Field(None, max_length=len(JobState))


@router.post(
    "/upload/batch",
    status_code=202,
    openapi_extra=REQUEST_BODY,
    dependencies=[WRITE, CHECK_PHOTO_QUOTA, ADMIT_JOB],
)
async def upload_batch(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    idempotent: IdempotentFormDep,
    admission: AdmissionDep,
    query: MapQuery,
) -> BatchAcceptedResponse:
    """Upload many photos: files of a form, or objects in the store.

    Objects in the store are named by a manifest of their keys or by a prefix. One job shows the
    progress. Each photo is processed as by `POST /upload`; a refused photo becomes a failed item
    and does not affect the others.
    """
    with admission.admit_upload(UploadKind.UPLOAD, request):
        received = await parse_batch_upload(request, gateway.store, gateway.settings)
    caller_params = _caller_params(get_caller(request), gateway.settings)
    accepted = await run_in_threadpool(
        _queue_batch, gateway, query.map, received, caller_params, idempotent
    )
    response.headers.update(accepted.headers)
    return accepted


@router.get("/jobs/{job_id}/items", operation_id="list_batch_items", dependencies=[READ])
def read_batch_items(
    gateway: GatewayDep, job_id: JobId, query: Annotated[BatchItemsParams, Query()]
) -> BatchItemsResponse:
    """List the photos of a batch, in upload order; of a prefix, after it has been listed."""
    after = _parse_item_cursor(query.cursor)
    with gateway.catalog.read() as session:
        job = get_job(session, get_map(session, query.map).id, job_id)
        if job.kind != JobKind.BATCH:
            raise Conflict("no_items", f"The job {job.id} ({job.kind}) is not a batch.")
        items = list_batch_items(session, job.id, query.state or [], query.limit + 1, after)
    page, next_cursor = query.split(items, lambda item: item.number)
    return BatchItemsResponse(
        items=[BatchItemResponse.model_validate(item) for item in page], next_cursor=next_cursor
    )


def _parse_item_cursor(cursor: str | None) -> int:
    if cursor is None:
        return 0
    if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 10):
        raise invalid_cursor_error()
    return int(cursor)


def _queue_batch(
    gateway: GatewayContext,
    map_name: str,
    received: BatchUpload,
    caller_params: dict[str, Any],
    idempotent: IdempotentRequest,
) -> BatchAcceptedResponse:
    try:
        idempotent.begin(received.idempotency_content())
        rows, source, params = _plan_items(gateway, received)
        with gateway.catalog.write() as session:
            map_id = get_map(session, map_name).id
            job = create_batch(session, map_id, source, {**params, **caller_params})
            if source != BatchSource.PREFIX:  # the steward lists its items
                add_batch_items(session, job, rows)
            items_url = job_url(job.id, map_name, "/items")
            accepted = BatchAcceptedResponse.of(job, map_name, items_url=items_url)
            idempotent.store_response(session, 202, accepted, accepted.headers)
            return accepted
    except (PlacewiseError, IdempotentReplay):
        # Not for other exceptions: after a lost connection the row may have been committed.
        discard_batch_upload(gateway.store, received)
        raise


def _caller_params(caller: Caller, settings: Settings) -> dict[str, Any]:
    """Job params with the caller's key and photo limit, which the steward applies."""
    if caller.key_id is None:
        return {}
    key_limit = get_photo_limit(caller, settings)
    return {"key_id": str(caller.key_id), "max_photos": key_limit[1] if key_limit else None}


def _plan_items(
    gateway: GatewayContext, received: BatchUpload
) -> tuple[list[dict[str, Any]], BatchSource, dict[str, Any]]:
    """Return the items as column values of BatchItem, their source, and the job params."""
    max_photos = gateway.settings.max_batch_photos
    if received.files:
        entries = read_jsonl_manifest(
            received.manifest or b"", "the manifest", max_entries=max_photos
        )
        return list(_form_file_items(received.files, entries)), BatchSource.FILES, {}
    if received.prefix is not None:
        return (
            [],
            BatchSource.PREFIX,
            {"prefix": validate_prefix(received.prefix, gateway.settings)},
        )
    entries = read_jsonl_manifest(
        received.manifest or b"", "the manifest", (KEY_FIELD,), max_photos
    )
    _validate_keys(entries)
    if not entries:
        raise Unprocessable("no_photos", "The manifest has no lines.")
    if len(entries) > max_photos:
        raise too_many_photos_error(max_photos)
    rows = [
        {"name": entry.name, "object_key": entry.name, "fields": entry.fields, "line": entry.line}
        for entry in entries
    ]
    return rows, BatchSource.KEYS, {}


def _form_file_items(
    files: list[BatchFile], entries: list[ManifestEntry]
) -> Iterator[dict[str, Any]]:
    count_by_name = Counter(file.name for file in files)
    errors = [
        (entry.line, f"the form has no file {entry.name!r}")
        for entry in entries
        if not count_by_name[entry.name]
    ]
    errors += [
        (entry.line, f"{count_by_name[entry.name]} files of the form are called {entry.name!r}")
        for entry in entries
        if count_by_name[entry.name] > 1
    ]
    if errors:
        raise bad_lines_error("bad_manifest", "the manifest", sorted(errors)[:MAX_REPORTED_LINES])
    by_name = {entry.name: entry for entry in entries}
    for file in files:
        entry = by_name.get(file.name)
        item: dict[str, Any] = {
            "name": file.name,
            "fields": entry.fields if entry else {},
            "line": entry.line if entry else None,
        }
        if file.error is None:
            item |= {
                "object_key": file.key,
                "source": {"size_bytes": file.size_bytes, "sha256": file.sha256},
            }
        else:
            item |= {"state": JobState.FAILED, "error": file.error.as_problem()}
        yield item


def validate_prefix(value: str, settings: Settings) -> str:
    """Return the key prefix to import, ending with `/`.

    Args:
        value: A prefix below `imports/`, or the same as `s3://S3_BUCKET/...`.

    Raises:
        Unprocessable: `invalid_field`, if it is another bucket or not below `imports/`.
    """
    prefix = value
    if value.startswith("s3://"):
        bucket, _, prefix = value.removeprefix("s3://").partition("/")
        if settings.s3_endpoint is None or bucket != settings.s3_bucket:
            raise invalid_field_error(
                PREFIX_FIELD,
                f"names the bucket {bucket!r}, but only the bucket of this server can be imported "
                f"from. Copy the photos below {IMPORTS} of it",
            )
    prefix = prefix.rstrip("/") + "/"
    if not (prefix.startswith(IMPORTS) and is_valid_key(prefix[:-1])):
        raise invalid_field_error(PREFIX_FIELD, f"is not below {IMPORTS}")
    return prefix


def _validate_keys(entries: list[ManifestEntry]) -> None:
    """Only objects below `imports/` may be imported: others may be photos of other maps."""
    errors = [
        (entry.line, f"{KEY_FIELD} is not below {IMPORTS}")
        for entry in entries
        if not (entry.name.startswith(IMPORTS) and is_valid_key(entry.name))
    ]
    if errors:
        raise bad_lines_error("bad_manifest", "the manifest", errors[:MAX_REPORTED_LINES])
