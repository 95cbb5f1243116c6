"""`/uploads/presign`: photos that callers send straight to the bucket.

```
POST /uploads/presign ─> a URL ─> PUT the bytes to incoming/<upload> ─> POST .../complete
                                                                           │
    originals/<new>  <─ copied by the store, and only then looked at ──────┘
```
A URL stays good until it expires, so what it leads to may change at any moment: what is checked,
described and acknowledged is the copy.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from contextlib import AbstractContextManager
from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from pydantic import Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.context import (
    DEFAULT_MAP,
    NO_NUL,
    Gateway,
    GatewayDep,
    MapName,
    UploadId,
)
from services.gateway.key_check import WRITE, caller_of
from services.gateway.once import OnceDep, Replay
from services.gateway.photos import PhotoPatch
from services.gateway.room import (
    ROOM_FOR_JOBS,
    ROOM_FOR_PHOTOS,
    Kind,
    RoomDep,
    place_for_photo,
)
from services.gateway.schemas import Answer, UploadAnswer, url_in_map
from services.gateway.upload import UPLOAD_ANSWERS, Said, answer_upload
from shared.catalog.base import db_now_plus
from shared.catalog.direct_uploads import DirectUpload, get_direct_upload
from shared.catalog.idempotency import KeptAnswer
from shared.catalog.maps import get_map
from shared.errors import Conflict, NotFound, PlacewiseError, Unavailable, Unprocessable
from shared.ids import new_id
from shared.intake.incoming import Incoming
from shared.intake.photo_fields import PhotoFields, check_pair
from shared.intake.photo_header import read_photo_header
from shared.intake.received import Received, base_name, check_photo_begin, file_too_large
from shared.intake.store_photo import Stored, store_photo
from shared.objects import DirectStore, ObjectInfo
from shared.objects.keys import incoming_key, new_original_key
from shared.objects.s3 import S3Store
from shared.photo_formats import SNIFFED_BYTES

router = APIRouter(tags=["photos"])

READ_BYTES = 256 * 1024
ABOUT_THE_FILE = ("filename", "file_size", "sha256")


class PresignRequest(PhotoPatch):
    """The file that will be sent, and what the form of `POST /upload` says of a photo."""

    filename: str = Field(min_length=1, max_length=255, pattern=NO_NUL)
    file_size: int = Field(gt=0, le=2**62, description="bytes")
    sha256: str = Field(pattern="^[0-9a-f]{64}$", description="of the bytes, hexadecimal")

    def said(self) -> dict[str, Any]:
        """What is said of the photo, as JSON."""
        return self.model_dump(mode="json", exclude=set(ABOUT_THE_FILE), exclude_none=True)


class PresignAnswer(Answer):
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
    response_model=PresignAnswer,
    dependencies=[WRITE, ROOM_FOR_PHOTOS, ROOM_FOR_JOBS],
)
def presign(
    request: Request,
    gateway: GatewayDep,
    wanted: PresignRequest,
    once: OnceDep,
    map_name: MapName = DEFAULT_MAP,
) -> PresignAnswer:
    """An address to which the photo's bytes can be sent without passing this server.

    Only where Placewise keeps its objects in a bucket (S3_ENDPOINT). Nothing is stored until the
    upload is completed.
    """
    store = _direct_store(gateway)
    limit = gateway.settings.max_file_size
    if wanted.file_size > limit:
        raise file_too_large(limit)
    said = wanted.said()
    _fields(said)  # what can't be understood is refused now, not after the bytes were sent
    request.app.state.quotas.take_bytes(caller_of(request), wanted.file_size)
    upload_id = new_id()
    seconds = gateway.settings.presign_seconds
    put = store.presign_put(
        incoming_key(upload_id),
        size_bytes=wanted.file_size,
        sha256=wanted.sha256,
        expires_seconds=seconds,
    )
    with gateway.catalog.write() as session:
        upload = DirectUpload(
            id=upload_id,
            map_id=get_map(session, map_name).id,
            filename=base_name(wanted.filename),
            size_bytes=wanted.file_size,
            sha256=wanted.sha256,
            said=said,
            expires_at=db_now_plus(seconds),
        )
        session.add(upload)
        session.flush()
        answer = PresignAnswer(
            upload_id=upload_id,
            method="PUT",
            url=put.url,
            headers=put.headers,
            complete_url=url_in_map(f"/uploads/presign/{upload_id}/complete", map_name),
            expires_at=upload.expires_at,
        )
        once.keep(session, 201, answer)
    return answer


@router.post(
    "/uploads/presign/{upload_id}/complete",
    operation_id="complete_upload",
    status_code=202,
    response_model=UploadAnswer,
    responses=UPLOAD_ANSWERS,
    dependencies=[WRITE, ROOM_FOR_PHOTOS, ROOM_FOR_JOBS],
)
async def complete(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    room: RoomDep,
    upload_id: Annotated[UploadId, PathParameter(description="as presigning answered it")],
    map_name: MapName = DEFAULT_MAP,
) -> UploadAnswer:
    """The bytes were sent: check and store the photo. Answers as `POST /upload` does; completed
    again, it answers the same again."""
    key = new_original_key()
    with room.receiving(Kind.UPLOAD, request):
        key_id = caller_of(request).key_id
        place = place_for_photo(request, gateway.settings)
        stored = await run_in_threadpool(
            _complete, gateway, map_name, upload_id, key, key_id, place
        )

    def replace(said: Said) -> None:
        with gateway.catalog.write() as session:
            upload = session.get(DirectUpload, upload_id)
            if upload is not None:  # its map may have been deleted during the wait
                upload.status, upload.answer = said.status, said.answer.model_dump_json()

    return await answer_upload(request, response, gateway, map_name, stored, key, replace)


def _complete(
    gateway: Gateway,
    map_name: str,
    upload_id: UUID,
    key: str,
    key_id: UUID | None,
    place: AbstractContextManager[None],
) -> Stored:
    """The photo, whose bytes lie under `key` unless the map had them. Raises Replay for an upload
    that was completed before."""
    store = _direct_store(gateway)
    with gateway.catalog.read() as session:
        upload = get_direct_upload(session, get_map(session, map_name).id, upload_id)
    _raise_if_completed(upload)
    sent = incoming_key(upload_id)
    try:
        _check_size(store.head(sent), upload)
        store.copy(sent, key)
    except NotFound:
        # Not there yet; or not any more, because another call has completed it since we looked.
        with gateway.catalog.read() as session:
            _raise_if_completed(get_direct_upload(session, upload.map_id, upload_id))
        raise _nothing_sent(upload) from None

    def keep(session: Session, stored: Stored) -> Stored:
        locked = get_direct_upload(session, upload.map_id, upload_id, lock=True)
        _raise_if_completed(locked)
        said = Said.of(stored, stored.job, key, map_name)
        locked.status, locked.answer = said.status, said.answer.model_dump_json()
        return stored

    try:
        _check_size(store.head(key), upload)
        received = _read(store, key, upload)
        media_type = check_photo_begin(received.begin)
        with store.open(key) as file:
            header = read_photo_header(file, gateway.settings.max_image_pixels)
        incoming = Incoming(received, media_type, header, _fields(upload.said), key_id)
        with place:
            stored = store_photo(gateway.catalog, gateway.hints, map_name, incoming, keep)
    except (PlacewiseError, Replay):
        store.delete(key)
        raise
    if stored.photo.object_key != key:
        store.delete(key)
    # Acknowledged already; what stays here is collected.
    with contextlib.suppress(Unavailable):
        store.delete(sent)
    return stored


def _read(store: DirectStore, key: str, upload: DirectUpload) -> Received:
    """The stored bytes as a form would have brought them; Unprocessable (`sha256_differs`)."""
    digest, begin, size = hashlib.sha256(), b"", 0
    with store.open(key) as file:
        while piece := file.read(READ_BYTES):
            if not size:
                begin = piece[:SNIFFED_BYTES]
            digest.update(piece)
            size += len(piece)
    if digest.hexdigest() != upload.sha256:
        raise Unprocessable(
            "sha256_differs",
            f"The bytes that were sent have the SHA-256 {digest.hexdigest()}, not {upload.sha256}. "
            "Send the announced file again to the same URL, or begin another upload.",
        )
    return Received(key, upload.filename, size, upload.sha256, begin)


def _check_size(found: ObjectInfo | None, upload: DirectUpload) -> None:
    """Unprocessable (`size_differs`), and NotFound where there is nothing."""
    if found is None:
        raise NotFound("object_not_found", "Nothing was sent.")
    if found.size_bytes != upload.size_bytes:
        raise Unprocessable(
            "size_differs",
            f"{found.size_bytes} bytes were sent, and {upload.size_bytes} announced. Send the "
            "announced file again to the same URL, or begin another upload.",
        )


def _nothing_sent(upload: DirectUpload) -> Conflict:
    return Conflict(
        "upload_incomplete",
        f"Nothing was sent for the upload {upload.id} yet: PUT the bytes to its URL first.",
    )


def _raise_if_completed(upload: DirectUpload) -> None:
    if upload.answer is None:
        return
    assert upload.status is not None
    headers = {"Location": json.loads(upload.answer)["status_url"]}
    if upload.status == 202:
        headers["Retry-After"] = "1"
    raise Replay(KeptAnswer(upload.status, headers, upload.answer))


def _fields(said: dict[str, Any]) -> PhotoFields:
    columns = PhotoPatch.model_validate(said).columns()
    if "attributes" in columns:
        columns["metadata"] = columns.pop("attributes")
    fields = PhotoFields(**columns)
    check_pair(fields.latitude, fields.longitude)
    return fields


def _direct_store(gateway: Gateway) -> DirectStore:
    if isinstance(gateway.store, S3Store):
        return gateway.store
    raise Conflict(
        "no_direct_uploads",
        "This Placewise keeps its photos in a folder, to which nobody can send them directly. "
        "Use POST /api/v1/upload.",
    )
