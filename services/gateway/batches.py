"""`POST /upload/batch`: many photos in, one job; `GET /jobs/{job_id}/items`: each of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from services.gateway.context import DEFAULT_MAP, Gateway, GatewayDep, JobId, MapName
from services.gateway.key_check import READ, WRITE, caller_of
from services.gateway.keys import Caller
from services.gateway.once import Once, OnceFormDep, Replay
from services.gateway.receive_batch import (
    ARCHIVE,
    FILE,
    MANIFEST,
    NDJSON,
    PREFIX,
    ReceivedBatch,
    UploadedFile,
    discard,
    receive_batch,
    too_many_photos,
)
from services.gateway.room import ROOM_FOR_JOBS, ROOM_FOR_PHOTOS, Kind, RoomDep, max_photos
from services.gateway.schemas import Answer, JobStarted, job_started, job_url
from shared.catalog.maps import get_map
from shared.errors import Conflict, PlacewiseError, Unprocessable, invalid_field
from shared.intake.manifest import KEY_FIELD, MOST_NAMED, Said, bad_lines, read_jsonl
from shared.jobs import JobKind, JobState
from shared.jobs.batches import BatchItem, BatchSource, list_batch, list_items, start_batch
from shared.jobs.table import get_job
from shared.objects.keys import is_key
from shared.settings import Settings

router = APIRouter(tags=["batches"])

PATH = "/upload/batch"

_FILE = {"type": "string", "format": "binary"}
_LINES = {
    "type": "string",
    "description": "JSONL: `filename` (of a file of the form) or `key` (of an object below "
    "IMPORT_PREFIX), and any of the fields of `POST /upload`",
}
BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {
                        FILE: {"type": "array", "items": _FILE, "description": "photos"},
                        ARCHIVE: {**_FILE, "description": "one zip, tar or gzipped tar"},
                        MANIFEST: _LINES,
                        PREFIX: {
                            "type": "string",
                            "description": "every photo below it: a folder below IMPORT_PREFIX, "
                            "or the same as s3://S3_BUCKET/...",
                        },
                    },
                }
            },
            NDJSON[0]: {"schema": _LINES},
        },
    }
}


class BatchStarted(JobStarted):
    """202: `items_url` tells of each photo."""

    items_url: str


class BatchItemAnswer(Answer):
    number: int = Field(description="from 1, in the order in which the photos came")
    name: str
    state: JobState = Field(description="`succeeded`: searchable")
    file_id: UUID | None
    job_id: UUID | None = Field(description="the job that describes the photo")
    already_there: bool = Field(description="the map had these bytes; none were stored")
    line: int | None = Field(description="of the manifest, where it speaks of the photo")
    error: dict[str, Any] | None = Field(description="an RFC 9457 problem")

    @classmethod
    def of(cls, item: BatchItem) -> BatchItemAnswer:
        return cls(
            number=item.number,
            name=item.name,
            state=JobState(item.state),
            file_id=item.photo_id,
            job_id=item.photo_job_id,
            already_there=item.already_there,
            line=item.line,
            error=item.error,
        )


class BatchItemsAnswer(Answer):
    items: list[BatchItemAnswer]
    next_cursor: str | None


@router.post(
    PATH,
    operation_id="upload_batch",
    status_code=202,
    response_model=BatchStarted,
    openapi_extra=BODY,
    dependencies=[WRITE, ROOM_FOR_PHOTOS, ROOM_FOR_JOBS],
)
async def upload_batch(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    once: OnceFormDep,
    room: RoomDep,
    map_name: MapName = DEFAULT_MAP,
) -> BatchStarted:
    """Bring in many photos: files of a form, one archive, or objects that lie in the store, named
    one by one or by their prefix.

    One job counts them. Each photo is taken as `POST /upload` takes it; one that is refused is an
    item that has failed, and the others go on.
    """
    with room.receiving(Kind.UPLOAD, request):
        received = await receive_batch(request, gateway.store, gateway.settings)
    whose = _whose(caller_of(request), gateway.settings)
    started = await run_in_threadpool(_queue, gateway, map_name, received, whose, once)
    response.headers["Location"] = started.status_url
    response.headers["Retry-After"] = "1"
    return started


@router.get(
    "/jobs/{job_id}/items",
    operation_id="list_batch_items",
    response_model=BatchItemsAnswer,
    dependencies=[READ],
)
def items(
    gateway: GatewayDep,
    job_id: JobId,
    state: Annotated[list[JobState] | None, Query()] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    cursor: Annotated[str | None, Query()] = None,
    map_name: MapName = DEFAULT_MAP,
) -> BatchItemsAnswer:
    """The photos of a batch, in their order; an archive's once it was looked through."""
    after = _after(cursor)
    with gateway.catalog.read() as session:
        job = get_job(session, get_map(session, map_name).id, job_id)
        if job.kind != JobKind.BATCH:
            raise Conflict("no_items", f"The job {job.id} ({job.kind}) is no batch.")
        found = list_items(session, job.id, state or [], limit + 1, after)
    page = found[:limit]
    return BatchItemsAnswer(
        items=[BatchItemAnswer.of(item) for item in page],
        next_cursor=str(page[-1].number) if len(found) > limit else None,
    )


def _after(cursor: str | None) -> int:
    if cursor is None:
        return 0
    if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 10):
        raise invalid_field("cursor", "is not one that this call has given")
    return int(cursor)


def _queue(
    gateway: Gateway, map_name: str, received: ReceivedBatch, whose: dict[str, Any], once: Once
) -> BatchStarted:
    try:
        once.begin(received.as_said())
        rows, source, params = _read(gateway, received)
        with gateway.catalog.write() as session:
            map_id = get_map(session, map_name).id
            job = start_batch(session, map_id, source, {**params, **whose})
            if source not in (BatchSource.ARCHIVE, BatchSource.PREFIX):  # the steward lists those
                list_batch(session, job, rows)
            session.flush()
            session.refresh(job)
            answer = job_started(job, map_name)
            items_url = job_url(job.id, map_name, "/items")
            started = BatchStarted(**answer.model_dump(), items_url=items_url)
            headers = {"Location": started.status_url, "Retry-After": "1"}
            once.keep(session, 202, started, headers)
            return started
    except (PlacewiseError, Replay):
        # Only what is certainly refused: after a lost connection the row may be committed.
        discard(gateway.store, received)
        raise


def _whose(caller: Caller, settings: Settings) -> dict[str, Any]:
    """What the steward has to know of the caller, as parameters of the job."""
    if caller.key_id is None:
        return {}
    limited = max_photos(caller, settings)
    return {"key_id": str(caller.key_id), "max_photos": limited[1] if limited else None}


def _read(
    gateway: Gateway, received: ReceivedBatch
) -> tuple[list[dict[str, Any]], BatchSource, dict[str, Any]]:
    """The batch's items as columns of BatchItem, where they come from, and its parameters."""
    if received.archive is not None:
        archive = received.archive
        return [], BatchSource.ARCHIVE, {"object_key": archive.key, "filename": archive.name}
    if received.files:
        said = read_jsonl(received.manifest or b"", "the manifest")
        return list(_files(received.files, said)), BatchSource.FILES, {}
    if received.prefix is not None:
        return [], BatchSource.PREFIX, {"prefix": checked_prefix(received.prefix, gateway.settings)}
    said = read_jsonl(received.manifest or b"", "the manifest", (KEY_FIELD,))
    _check_keys(said, gateway.settings.import_prefix)
    if not said:
        raise Unprocessable("no_photos", "The manifest has no line.")
    if len(said) > gateway.settings.max_batch_photos:
        raise too_many_photos(gateway.settings.max_batch_photos)
    rows = [
        {"name": one.name, "object_key": one.name, "fields": one.fields, "line": one.line}
        for one in said
    ]
    return rows, BatchSource.KEYS, {}


def _files(files: list[UploadedFile], said: list[Said]) -> Iterator[dict[str, Any]]:
    times = Counter(file.name for file in files)
    strange = [
        (one.line, f"the form has no file {one.name!r}") for one in said if not times[one.name]
    ]
    strange += [
        (one.line, f"{times[one.name]} files of the form are called {one.name!r}")
        for one in said
        if times[one.name] > 1
    ]
    if strange:
        raise bad_lines("bad_manifest", "the manifest", sorted(strange)[:MOST_NAMED])
    by_name = {one.name: one for one in said}
    for file in files:
        line = by_name.get(file.name)
        item: dict[str, Any] = {
            "name": file.name,
            "fields": line.fields if line else {},
            "line": line.line if line else None,
        }
        if file.error is None:
            item |= {
                "object_key": file.key,
                "source": {"size_bytes": file.size_bytes, "sha256": file.sha256},
            }
        else:
            item |= {"state": JobState.FAILED, "error": file.error.as_problem()}
        yield item


def checked_prefix(said: str, settings: Settings) -> str:
    """The folder of keys that is meant; 422 unless the operator has given it free."""
    prefix = said
    if said.startswith("s3://"):
        bucket, _, prefix = said.removeprefix("s3://").partition("/")
        if settings.s3_endpoint is None or bucket != settings.s3_bucket:
            raise invalid_field(
                PREFIX,
                f"names the bucket {bucket!r}, which is not this Placewise's own. Copy the photos "
                f"below {settings.import_prefix} of its store",
            )
    prefix = prefix.rstrip("/") + "/"
    if not (prefix.startswith(settings.import_prefix) and is_key(prefix[:-1])):
        raise invalid_field(PREFIX, f"is not below {settings.import_prefix} (IMPORT_PREFIX)")
    return prefix


def _check_keys(said: list[Said], prefix: str) -> None:
    """Only what the operator has given free: all else in the store is someone's photo."""
    bad = [
        (one.line, f"{KEY_FIELD} is not below {prefix} (IMPORT_PREFIX)")
        for one in said
        if not (one.name.startswith(prefix) and is_key(one.name))
    ]
    if bad:
        raise bad_lines("bad_manifest", "the manifest", bad[:MOST_NAMED])
