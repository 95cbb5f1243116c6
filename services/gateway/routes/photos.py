"""`/uploads/{file_id}` and `/search`: one photo, and photos by what is known of them."""

from __future__ import annotations

import base64
import binascii
import time
from collections.abc import Iterator
from datetime import datetime
from typing import Annotated, Any, BinaryIO
from urllib.parse import quote
from uuid import UUID

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import DEFAULT_MAP, NO_NUL_PATTERN, FileId, GatewayDep, MapName
from services.gateway.schemas import (
    DeletedPhotoResponse,
    MetadataSearchResponse,
    PhotoDetailResponse,
    PhotoResponse,
)
from services.gateway.search_params import FilterDep
from shared.catalog.chunks import find_descriptor
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map, increment_map_version, lock_map
from shared.catalog.photo_search import MAX_COUNTED_MATCHES, MetadataFilter, search_photos
from shared.catalog.photos import Photo, PhotoRole, get_photo, mark_photo_deleted
from shared.errors import NotFound, invalid_field_error
from shared.ingest.photo_metadata import (
    check_coordinate_pair,
    check_metadata,
    parse_tags,
    parse_time,
)
from shared.jobs import Job
from shared.jobs.transitions import cancel_jobs
from shared.storage.keys import thumbnail_key

router = APIRouter(tags=["photos"])

STREAM_READ_BYTES = 256 * 1024
IMAGE_RESPONSE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/*": {}}, "description": "The picture."}
}


@router.get(
    "/uploads/{file_id}",
    operation_id="get_photo",
    response_model=PhotoDetailResponse,
    dependencies=[READ],
)
def read_photo(
    gateway: GatewayDep, file_id: FileId, map_name: MapName = DEFAULT_MAP
) -> PhotoDetailResponse:
    """What is known of one photo."""
    with gateway.catalog.read() as session:
        found = get_photo(session, get_map(session, map_name).id, file_id)
        return _photo_detail_response(session, found, map_name)


class PhotoUpdate(BaseModel):
    """What to change; what is left out stays, null clears."""

    model_config = ConfigDict(extra="forbid")

    latitude: Annotated[float | None, Field(ge=-90, le=90, allow_inf_nan=False)] = None
    longitude: Annotated[float | None, Field(ge=-180, le=180, allow_inf_nan=False)] = None
    heading: Annotated[float | None, Field(ge=0, le=360, allow_inf_nan=False)] = None
    captured_at: str | None = None
    place: Annotated[str | None, Field(max_length=500, pattern=NO_NUL_PATTERN)] = None
    tags: list[Annotated[str, Field(pattern=NO_NUL_PATTERN)]] | None = None
    metadata: dict[str, Any] | None = None
    role: PhotoRole | None = None

    def to_columns(self) -> dict[str, Any]:
        """The photo's columns that are said, with their new values."""
        said = self.model_dump(exclude_unset=True)
        if said.get("captured_at") is not None:
            said["captured_at"] = parse_time("captured_at", said["captured_at"])
        if said.get("heading") is not None:
            said["heading"] %= 360
        if "place" in said:
            said["place"] = (said["place"] or "").strip() or None
        if "tags" in said:
            said["tags"] = parse_tags(said["tags"] or [])
        if "metadata" in said:
            said["attributes"] = said.pop("metadata") or {}
            check_metadata(said["attributes"])
        if "role" in said:
            said["role"] = said["role"] or PhotoRole.DATABASE
        return said


@router.patch(
    "/uploads/{file_id}",
    operation_id="patch_photo",
    response_model=PhotoDetailResponse,
    dependencies=[WRITE],
)
def patch_photo(
    gateway: GatewayDep,
    file_id: FileId,
    patch: PhotoUpdate,
    map_name: MapName = DEFAULT_MAP,
) -> PhotoDetailResponse:
    """Change where, when and what of a photo; its descriptor stays."""
    columns = patch.to_columns()
    with gateway.catalog.write() as session:
        map_ = lock_map(session, get_map(session, map_name).id)
        found = get_photo(session, map_.id, file_id)
        for name, value in columns.items():
            setattr(found, name, value)
        check_coordinate_pair(found.latitude, found.longitude)
        found.changed_version = increment_map_version(session, map_.id)
        session.flush()
        return _photo_detail_response(session, found, map_name)


@router.delete(
    "/uploads/{file_id}",
    operation_id="delete_photo",
    response_model=DeletedPhotoResponse,
    dependencies=[WRITE],
)
def delete_photo(
    gateway: GatewayDep, file_id: FileId, map_name: MapName = DEFAULT_MAP
) -> DeletedPhotoResponse:
    """Gone from every answer at once; the bytes follow within seconds."""

    def remove(session: Session) -> str:
        map_ = lock_map(session, get_map(session, map_name).id)
        found = get_photo(session, map_.id, file_id)
        mark_photo_deleted(session, found, increment_map_version(session, map_.id))
        cancel_jobs(session, Job.photo_id == found.id)
        return found.filename

    filename = gateway.catalog.run(remove)
    return DeletedPhotoResponse(
        success=True, message=f"{filename} is deleted.", deleted_file_id=file_id
    )


@router.get(
    "/uploads/{file_id}/image",
    operation_id="get_image",
    response_class=Response,
    responses=IMAGE_RESPONSE,
    dependencies=[READ],
)
def read_image(
    request: Request,
    gateway: GatewayDep,
    file_id: FileId,
    map_name: MapName = DEFAULT_MAP,
) -> Response:
    """The photo's bytes as they were uploaded."""
    with gateway.catalog.read() as session:
        found = get_photo(session, get_map(session, map_name).id, file_id)
    etag = f'"{found.sha256}"'
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers={"ETag": etag})
    return StreamingResponse(
        _read_blocks(gateway.store.open(found.object_key)),
        media_type=found.media_type,
        headers={
            "Content-Length": str(found.size_bytes),
            "Content-Disposition": f"inline; filename*=UTF-8''{quote(found.filename)}",
            "ETag": etag,
            "Cache-Control": "private, no-cache",  # kept by this browser, and asked for each time
        },
    )


@router.get(
    "/uploads/{file_id}/thumbnail",
    operation_id="get_thumbnail",
    response_class=Response,
    responses=IMAGE_RESPONSE,
    dependencies=[READ],
)
def read_thumbnail(
    gateway: GatewayDep, file_id: FileId, map_name: MapName = DEFAULT_MAP
) -> Response:
    """A small JPEG without any metadata; it is there once the photo has been described."""
    with gateway.catalog.read() as session:
        found = get_photo(session, get_map(session, map_name).id, file_id)
    try:
        data = gateway.store.get(thumbnail_key(found.id))
    except NotFound:
        raise NotFound(
            "thumbnail_not_found",
            "The photo has no thumbnail yet: it is not described.",
        ) from None
    return Response(data, media_type="image/jpeg")


@router.get(
    "/search",
    operation_id="search_metadata",
    response_model=MetadataSearchResponse,
    dependencies=[READ],
)
def search_photos_by_metadata(
    gateway: GatewayDep,
    photos: FilterDep,
    filename: Annotated[
        str | None, Query(max_length=255, description="part of the name, case ignored")
    ] = None,
    upload_after: Annotated[str | None, Query(description="ISO 8601; no offset means UTC")] = None,
    upload_before: Annotated[str | None, Query(description="ISO 8601; no offset means UTC")] = None,
    min_file_size: Annotated[int | None, Query(ge=0, le=2**62)] = None,
    max_file_size: Annotated[int | None, Query(ge=0, le=2**62)] = None,
    role: Annotated[PhotoRole | None, Query(description="left out: of both roles")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before")] = None,
    map_name: MapName = DEFAULT_MAP,
) -> MetadataSearchResponse:
    """Photos by what is known of them, newest first, a page at a time."""
    started = time.perf_counter()
    if filename is not None and "\0" in filename:
        raise invalid_field_error("filename", "holds a NUL character")
    wanted = MetadataFilter(
        filename=filename,
        upload_after=parse_time("upload_after", upload_after) if upload_after else None,
        upload_before=parse_time("upload_before", upload_before) if upload_before else None,
        min_file_size=min_file_size,
        max_file_size=max_file_size,
        photos=photos,
        role=role,
    )
    after = _decode_cursor(cursor) if cursor else None
    with gateway.catalog.read() as session:
        map_id = get_map(session, map_name).id
        found, total = search_photos(session, map_id, wanted, limit + 1, after)
    page = found[:limit]
    return MetadataSearchResponse(
        total_found=total,
        total_is_exact=total < MAX_COUNTED_MATCHES,
        images=[PhotoResponse(**PhotoResponse.fields_of(item, map_name)) for item in page],
        next_cursor=_encode_cursor(page[-1]) if len(found) > limit else None,
        query_time_ms=(time.perf_counter() - started) * 1000,
    )


def _photo_detail_response(session: Session, found: Photo, map_name: str) -> PhotoDetailResponse:
    generation = active_generation(session, found.map_id)
    searchable = generation is not None and find_descriptor(session, generation.id, found.id)
    return PhotoDetailResponse(
        **PhotoResponse.fields_of(found, map_name),
        job_id=found.job_id,
        media_type=found.media_type,
        sha256=found.sha256,
        searchable=bool(searchable),
    )


def _read_blocks(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while piece := file.read(STREAM_READ_BYTES):
            yield piece


def _encode_cursor(last: Photo) -> str:
    return base64.urlsafe_b64encode(f"{last.uploaded_at.isoformat()} {last.id}".encode()).decode()


def _decode_cursor(cursor: str) -> tuple[datetime, UUID]:
    try:
        uploaded_at, photo_id = base64.urlsafe_b64decode(cursor.encode()).decode().split(" ")
        return parse_time("cursor", uploaded_at), UUID(photo_id)
    except (ValueError, binascii.Error):
        raise invalid_field_error("cursor", "is not one that this call has given") from None
