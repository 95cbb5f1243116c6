"""Routes of stored photos: read, update, delete, images and metadata search."""

from __future__ import annotations

import base64
import binascii
import time
from collections.abc import Iterator
from datetime import datetime
from functools import partial
from typing import Annotated, Any, BinaryIO
from urllib.parse import quote
from uuid import UUID

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response, StreamingResponse
from pydantic import Field
from sqlalchemy.orm import Session

from services.gateway.admission import AdmissionControl, AdmissionDep
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import (
    NO_NUL_PATTERN,
    FileId,
    GatewayContext,
    GatewayDep,
    MapParams,
    MapQuery,
    invalid_cursor_error,
)
from services.gateway.photo_search import MAX_COUNTED_MATCHES, MetadataSearchParams, search_photos
from services.gateway.responses import JobAcceptedResponse, MetadataSearchResponse, photo_response
from shared.catalog.chunks import find_descriptor
from shared.catalog.database.base import insert_row
from shared.catalog.generations import active_generation
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.maps import get_map, increment_map_version, lock_map
from shared.catalog.photos import Photo, PhotoRole, find_same_photo, get_photo, mark_photo_deleted
from shared.errors import Conflict, NotFound
from shared.http.request_model import RequestModel
from shared.imaging.capture_place import MAX_ALTITUDE_M
from shared.imaging.file_formats import needs_preview
from shared.ingest.photo_metadata import (
    MAX_METADATA_FIELDS,
    MAX_PATH_CHARACTERS,
    MAX_TAGS,
    MAX_TEXT_CHARACTERS,
    check_metadata,
    coordinate_pair,
    parse_relative_path,
    parse_tags,
    parse_time,
)
from shared.jobs import Job, JobKind, JobState
from shared.jobs.transitions import cancel_jobs, requeue_job_as_new
from shared.jobs.wakeups import JobMessage
from shared.responses.jobs import DeletedPhotoResponse
from shared.responses.similarity import PhotoDetailResponse, PhotoResponse
from shared.storage.keys import preview_key, thumbnail_key

router = APIRouter(tags=["photos"])

STREAM_READ_BYTES = 256 * 1024
IMAGE_RESPONSE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/*": {}}, "description": "The image."}
}


@router.get("/uploads/{file_id}", operation_id="get_photo", dependencies=[READ])
def read_photo(gateway: GatewayDep, file_id: FileId, query: MapQuery) -> PhotoDetailResponse:
    """Get the metadata of a photo and the state of its job."""
    with gateway.catalog.read() as session:
        photo = get_photo(session, get_map(session, query.map).id, file_id)
        return _photo_detail_response(session, photo, query.map)


Label = Annotated[str, Field(max_length=MAX_TEXT_CHARACTERS, pattern=NO_NUL_PATTERN)]


class PhotoUpdate(RequestModel):
    """Fields to update: omitted fields are unchanged, null clears a field."""

    latitude: Annotated[float | None, Field(ge=-90, le=90, allow_inf_nan=False)] = None
    longitude: Annotated[float | None, Field(ge=-180, le=180, allow_inf_nan=False)] = None
    altitude: Annotated[
        float | None, Field(ge=-MAX_ALTITUDE_M, le=MAX_ALTITUDE_M, allow_inf_nan=False)
    ] = None
    heading: Annotated[float | None, Field(ge=0, le=360, allow_inf_nan=False)] = None
    captured_at: Annotated[str | None, Field(max_length=100)] = None
    place: Label | None = None
    tags: Annotated[list[Label] | None, Field(max_length=MAX_TAGS)] = None
    metadata: Annotated[dict[str, Any] | None, Field(max_length=MAX_METADATA_FIELDS)] = None
    role: PhotoRole | None = None
    relative_path: str | None = Field(
        None,
        max_length=MAX_PATH_CHARACTERS,
        pattern=NO_NUL_PATTERN,
        description="path in its folder or archive, such as Day 2/IMG_2078.jpg",
    )

    def to_columns(self) -> dict[str, Any]:
        """Return the new values of the photo's columns, for the fields that are set."""
        columns = self.model_dump(exclude_unset=True)
        if columns.get("captured_at") is not None:
            columns["captured_at"] = parse_time("captured_at", columns["captured_at"])
        if columns.get("heading") is not None:
            columns["heading"] %= 360
        if "place" in columns:
            columns["place"] = (columns["place"] or "").strip() or None
        if "relative_path" in columns:
            columns["relative_path"] = parse_relative_path(columns["relative_path"] or "")
        if "tags" in columns:
            columns["tags"] = parse_tags(columns["tags"] or [])
        if "metadata" in columns:
            columns["attributes"] = columns.pop("metadata") or {}
            check_metadata(columns["attributes"])
        if "role" in columns:
            columns["role"] = columns["role"] or PhotoRole.DATABASE
        return columns


@router.patch("/uploads/{file_id}", dependencies=[WRITE])
def patch_photo(
    gateway: GatewayDep, file_id: FileId, patch: PhotoUpdate, query: MapQuery
) -> PhotoDetailResponse:
    """Update the metadata of a photo. Its descriptor is unchanged."""
    columns = patch.to_columns()
    with gateway.catalog.write() as session:
        map_ = lock_map(session, get_map(session, query.map).id)
        photo = get_photo(session, map_.id, file_id)
        for name, value in columns.items():
            setattr(photo, name, value)
        photo.latitude, photo.longitude = coordinate_pair(photo.latitude, photo.longitude)
        if columns.get("captured_at") is not None:  # UTC
            utc = {"time_zone_is_known": True, "clock_offset_seconds": None}
            photo.capture = {**(photo.capture or {}), **utc}
        photo.changed_version = increment_map_version(session, map_.id)
        session.flush()
        return _photo_detail_response(session, photo, query.map)


class DeletePhotoParams(MapParams):
    permanently: bool = Field(False, description="delete its bytes within seconds, for good")


@router.delete("/uploads/{file_id}", dependencies=[WRITE])
def delete_photo(
    gateway: GatewayDep, file_id: FileId, query: Annotated[DeletePhotoParams, Query()]
) -> DeletedPhotoResponse:
    """Delete a photo. No search returns it any more.

    It can be restored for REMOVED_PHOTO_DAYS, unless it is deleted `permanently`, which a photo in
    the trash can be, too. Its bytes are deleted then.
    """
    days = 0.0 if query.permanently else gateway.settings.removed_photo_days

    def remove(session: Session) -> str:
        map_ = lock_map(session, get_map(session, query.map).id)
        photo = get_photo(session, map_.id, file_id, or_removed=query.permanently)
        mark_photo_deleted(session, photo, increment_map_version(session, map_.id), days)
        cancel_jobs(session, Job.photo_id == photo.id)
        return photo.filename

    filename = gateway.catalog.run(remove)
    until = f"; it can be restored for {days:g} days" if days else ""
    return DeletedPhotoResponse(
        success=True, message=f"The photo {filename} is deleted{until}.", deleted_file_id=file_id
    )


@router.post("/uploads/{file_id}/restore", dependencies=[WRITE])
def restore_photo(
    gateway: GatewayDep, admission: AdmissionDep, file_id: FileId, query: MapQuery
) -> PhotoDetailResponse:
    """Restore a deleted photo from the trash; it is described again if it has to be.

    A photo that is not deleted stays as it is. 409 (`photo_exists`) if its bytes were uploaded
    again meanwhile.
    """
    admission.admit_job(query.map)

    def restore(session: Session) -> tuple[PhotoDetailResponse, JobMessage | None]:
        map_ = lock_map(session, get_map(session, query.map).id)
        photo = get_photo(session, map_.id, file_id, or_removed=True)
        if photo.deleted_at is None:
            return _photo_detail_response(session, photo, query.map), None
        same = find_same_photo(session, map_.id, photo.sha256, photo.picture_sha256)
        if same is not None:
            raise Conflict(
                "photo_exists",
                f"The photo {photo.filename} was added again meanwhile.",
                file_id=str(same.id),
            )
        photo.deleted_at = photo.purge_at = None
        photo.changed_version = increment_map_version(session, map_.id)
        # Compaction may have dropped its descriptor; one that is still there stays as it is.
        job = _queue_again(session, photo)
        message = JobMessage.of(job, query.map, photo.filename)
        return _photo_detail_response(session, photo, query.map), message

    response, message = gateway.catalog.run(restore)
    if message is not None:
        gateway.wakeups.send(message)
    return response


@router.get(
    "/uploads/{file_id}/image",
    response_class=Response,
    responses=IMAGE_RESPONSE,
    dependencies=[READ],
)
def get_image(request: Request, gateway: GatewayDep, file_id: FileId, query: MapQuery) -> Response:
    """Get the original bytes of a photo."""
    with gateway.catalog.read() as session:
        photo = get_photo(session, get_map(session, query.map).id, file_id)
    return _original_response(request, gateway, photo)


def _original_response(request: Request, gateway: GatewayContext, photo: Photo) -> Response:
    etag = f'"{photo.sha256}"'
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers={"ETag": etag})
    return StreamingResponse(
        _read_blocks(gateway.store.open(photo.object_key)),
        media_type=photo.media_type,
        headers={
            "Content-Length": str(photo.size_bytes),
            "Content-Disposition": f"inline; filename*=UTF-8''{quote(photo.filename)}",
            "ETag": etag,
            "Cache-Control": "private, no-cache",  # browsers may cache, but must revalidate
        },
    )


@router.get(
    "/uploads/{file_id}/thumbnail",
    response_class=Response,
    responses=IMAGE_RESPONSE,
    dependencies=[READ],
)
def get_thumbnail(gateway: GatewayDep, file_id: FileId, query: MapQuery) -> Response:
    """Get a small JPEG without metadata; it exists once the photo has been described.

    Photos in the trash have it, too.
    """
    with gateway.catalog.read() as session:
        photo = get_photo(session, get_map(session, query.map).id, file_id, or_removed=True)
    try:
        data = gateway.store.get(thumbnail_key(photo.id))
    except NotFound:
        raise NotFound(
            "thumbnail_not_found",
            "The photo has no thumbnail yet, because it has not been described.",
        ) from None
    return Response(data, media_type="image/jpeg")


@router.get(
    "/uploads/{file_id}/preview",
    response_class=Response,
    responses={
        **IMAGE_RESPONSE,
        202: {
            "model": JobAcceptedResponse,
            "description": "The preview does not exist yet; this job makes it.",
        },
    },
    dependencies=[READ],
)
def get_preview(
    request: Request,
    gateway: GatewayDep,
    admission: AdmissionDep,
    file_id: FileId,
    query: MapQuery,
) -> Response:
    """Get a photo as browsers show it: an upright JPEG of at most 1,600 pixels without metadata.

    The preview is made when the photo is described. If it does not exist, the photo's job is
    queued again, and the response is 202. A JPEG, PNG or WebP photo of at most 1,600 pixels has no
    preview: the response is the original.
    """
    with gateway.catalog.read() as session:
        photo = get_photo(session, get_map(session, query.map).id, file_id)
    if not needs_preview(photo.media_type, photo.width, photo.height):
        return _original_response(request, gateway, photo)
    headers = {"ETag": f'"{photo.sha256}-preview"', "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    try:
        data = gateway.store.get(preview_key(photo.id))
    except NotFound:
        job = gateway.catalog.run(
            lambda session: _queue_preview(session, admission, photo, query.map)
        )
        gateway.wakeups.send(JobMessage.of(job, query.map, photo.filename))
        return JobAcceptedResponse.of(job, query.map).to_http()
    return Response(data, media_type="image/jpeg", headers=headers)


def _queue_preview(
    session: Session, admission: AdmissionControl, photo: Photo, map_name: str
) -> Job:
    """Return the photo's job, which makes the preview; queued again unless it is unfinished."""
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is not None and job.state in UNFINISHED_STATES:
        return job
    if job is not None and job.state != JobState.SUCCEEDED:
        reason = job.error["detail"] if job.error else f"Its job is {job.state}."
        raise NotFound(
            "preview_not_found",
            f"The photo has no preview, because it has not been described. {reason}",
        )
    admission.admit_job(map_name)
    return _queue_again(session, photo)


def _queue_again(session: Session, photo: Photo) -> Job:
    """Queue the photo's job again; a photo that was described has a descriptor, which stays."""
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is None:  # deleted, or lost with the catalog
        job = Job(
            map_id=photo.map_id,
            kind=JobKind.INDEX,
            photo_id=photo.id,
            result={"file_id": str(photo.id)},  # described before: webhooks get no second event
        )
        insert_row(session, job)
        get_photo(session, photo.map_id, photo.id).job_id = job.id
    else:
        requeue_job_as_new(job, keep_result=True)
        session.flush()
    return job


@router.get("/search", dependencies=[READ])
def search_metadata(
    gateway: GatewayDep, query: Annotated[MetadataSearchParams, Query()]
) -> MetadataSearchResponse:
    """Search photos by their metadata, newest first, with a cursor (of the same `sort`)."""
    started = time.perf_counter()
    after = _decode_cursor(query.cursor) if query.cursor else None
    with gateway.catalog.read() as session:
        map_id = get_map(session, query.map).id
        matches, total = search_photos(session, map_id, query, query.limit + 1, after)
    page, next_cursor = query.split(matches, partial(_encode_cursor, query))
    return MetadataSearchResponse(
        total_found=total,
        total_is_exact=total < MAX_COUNTED_MATCHES,
        images=[photo_response(PhotoResponse, photo, query.map) for photo in page],
        next_cursor=next_cursor,
        query_time_ms=(time.perf_counter() - started) * 1000,
    )


def _photo_detail_response(session: Session, photo: Photo, map_name: str) -> PhotoDetailResponse:
    generation = active_generation(session, photo.map_id)
    searchable = generation is not None and find_descriptor(session, generation.id, photo.id)
    return photo_response(PhotoDetailResponse, photo, map_name, searchable=bool(searchable))


def _read_blocks(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while block := file.read(STREAM_READ_BYTES):
            yield block


def _encode_cursor(query: MetadataSearchParams, last: Photo) -> str:
    time = last.captured_at if query.sort == "taken" else last.uploaded_at
    assert time is not None
    return base64.urlsafe_b64encode(f"{time.isoformat()} {last.id}".encode()).decode()


def _decode_cursor(cursor: str) -> tuple[datetime, UUID]:
    try:
        uploaded_at, photo_id = base64.urlsafe_b64decode(cursor.encode()).decode().split(" ")
        return parse_time("cursor", uploaded_at), UUID(photo_id)
    except (ValueError, binascii.Error):
        raise invalid_cursor_error() from None
