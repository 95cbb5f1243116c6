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

from services.gateway.context import DEFAULT_MAP, Gateway, GatewayDep, MapName
from services.gateway.key_check import WRITE, caller_of
from services.gateway.once import OnceFormDep
from services.gateway.receive import describe_form, receive_file
from services.gateway.room import (
    ROOM_FOR_JOBS,
    ROOM_FOR_PHOTOS,
    Kind,
    RoomDep,
    place_for_photo,
)
from services.gateway.schemas import UploadAnswer, url_in_map
from services.gateway.waiting import preferred_wait, wait_for_job
from shared.catalog.photos import PhotoRole
from shared.errors import PlacewiseError
from shared.intake.incoming import examine
from shared.intake.received import Received, check_photo_begin
from shared.intake.store_photo import Keep, Stored, store_photo
from shared.jobs import Job, JobState
from shared.jobs.table import UNFINISHED
from shared.objects.keys import new_original_key
from shared.photo_formats import ACCEPTED

router = APIRouter(tags=["photos"])

_TEXT = {"type": "string"}
FORM = describe_form(
    ACCEPTED,
    latitude={"type": "number", "minimum": -90, "maximum": 90},
    longitude={"type": "number", "minimum": -180, "maximum": 180},
    heading={"type": "number", "minimum": 0, "maximum": 360},
    captured_at={"type": "string", "format": "date-time"},
    place={**_TEXT, "description": "a label, where coordinates say little"},
    tags={**_TEXT, "description": "separated by commas"},
    metadata={**_TEXT, "description": "a JSON object"},
    role={
        "type": "string",
        "enum": list(PhotoRole),
        "description": "`query`: a labelled query, never found; evaluations ask with it",
    },
)

UPLOAD_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"model": UploadAnswer, "description": "The map has these bytes already."},
    201: {"model": UploadAnswer, "description": "Searchable (with `Prefer: wait=N`)."},
}


@router.post(
    "/upload",
    operation_id="upload",
    status_code=202,
    response_model=UploadAnswer,
    responses=UPLOAD_ANSWERS,
    openapi_extra=FORM,
    dependencies=[WRITE, ROOM_FOR_PHOTOS, ROOM_FOR_JOBS],
)
async def upload(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    once: OnceFormDep,
    room: RoomDep,
    map_name: MapName = DEFAULT_MAP,
) -> UploadAnswer:
    """Store a photo and queue its description. EXIF fills what the form leaves out.

    202 with the job to poll; with `Prefer: wait=N`, 201 once the photo is searchable. The same
    bytes again give the existing photo (200), or queue it again after a failed job (202).
    """
    with room.receiving(Kind.UPLOAD, request):
        received = await receive_file(
            request,
            gateway.store,
            new_original_key(),
            gateway.settings.max_file_size,
            check_photo_begin,
        )
    await once.begin_form(gateway.store, received)

    def keep(session: Session, stored: Stored) -> Stored:
        said = Said.of(stored, stored.job, received.key, map_name)
        once.keep(session, said.status, said.answer, said.headers)
        return stored

    key_id = caller_of(request).key_id
    place = place_for_photo(request, gateway.settings)
    stored = await run_in_threadpool(_store, gateway, map_name, received, key_id, place, keep)

    def replace(said: Said) -> None:
        once.replace(said.status, said.answer, said.headers)

    return await answer_upload(request, response, gateway, map_name, stored, received.key, replace)


@dataclass(frozen=True, slots=True)
class Said:
    """What an upload is answered."""

    status: int
    headers: dict[str, str]
    answer: UploadAnswer

    @classmethod
    def of(cls, stored: Stored, job: Job | None, key: str, map_name: str) -> Said:
        """`job` as it is now, and the `key` of the bytes that came."""
        status_url = url_in_map(
            f"/jobs/{job.id}" if job else f"/uploads/{stored.photo.id}", map_name
        )
        answer = UploadAnswer(
            file_id=stored.photo.id,
            job_id=job.id if job else None,
            filename=stored.photo.filename,
            file_size=stored.photo.size_bytes,
            upload_time=stored.photo.uploaded_at,
            status=JobState(job.state) if job else JobState.SUCCEEDED,
            status_url=status_url,
            already_there=stored.photo.object_key != key,
            message=_message(stored, job),
        )
        if not stored.queued or job is None:
            return cls(200, {"Location": status_url}, answer)
        if job.state == JobState.SUCCEEDED:
            return cls(201, {"Location": status_url}, answer)
        return cls(202, {"Location": status_url, "Retry-After": "1"}, answer)


async def answer_upload(
    request: Request,
    response: Response,
    gateway: Gateway,
    map_name: str,
    stored: Stored,
    key: str,
    replace: Callable[[Said], None],
) -> UploadAnswer:
    """What is answered to an upload that was kept, after the wait that the request prefers.

    `key` is that of the bytes that came; `replace` is told when the photo was described meanwhile,
    to answer so again.
    """
    job = stored.job
    wait = preferred_wait(request, gateway.settings.max_wait_seconds)
    if wait and stored.queued and job is not None:
        response.headers["Preference-Applied"] = f"wait={wait:g}"
        job = await wait_for_job(gateway, job.id, wait)
    said = Said.of(stored, job, key, map_name)
    if said.status == 201:
        await run_in_threadpool(replace, said)
    response.status_code = said.status
    response.headers.update(said.headers)
    return said.answer


def _store(
    gateway: Gateway,
    map_name: str,
    received: Received,
    key_id: UUID | None,
    place: AbstractContextManager[None],
    keep: Keep,
) -> Stored:
    """Check what came and acknowledge it; whatever is not kept leaves no bytes behind."""
    try:
        incoming = examine(gateway.store, received, gateway.settings.max_image_pixels, key_id)
        with place:
            stored = store_photo(gateway.catalog, gateway.hints, map_name, incoming, keep)
    except PlacewiseError:
        # Only what is certainly refused: after a lost connection the row may be committed.
        gateway.store.delete(received.key)
        raise
    if stored.photo.object_key != received.key:
        gateway.store.delete(received.key)
    return stored


def _message(stored: Stored, job: Job | None) -> str:
    if not stored.queued:
        return "The map has this photo already."
    if job is None or job.state in UNFINISHED:
        return "Stored; it is described in the background."
    if job.state == JobState.SUCCEEDED:
        return "Stored and searchable."
    reason = (job.error or {}).get("detail", "")
    return f"Stored, but its job is {job.state}. {reason}".strip()
