"""Metadata search: photo filters as SQL conditions, and pages of matching photos.

Rare matches are looked up in an index of their conditions and sorted; frequent ones are found by
scanning from the newest photo. The matches are counted first to choose between the two, so that the
plan does not depend on the estimates of the planner.
"""

from __future__ import annotations

from datetime import datetime
from typing import Literal
from uuid import UUID

from pydantic import Field
from sqlalchemy import Select, Uuid, func, literal, or_, select, tuple_
from sqlalchemy.orm import Session, aliased

from services.gateway.dependencies import NO_NUL_PATTERN, PageParams
from services.gateway.similarity.search_params import FilterParams
from shared.catalog.chunks import select_failed_photos
from shared.catalog.database.base import (
    Condition,
    UtcDateTime,
    count_rows,
    db_distance_m,
    filename_trigrams,
    json_array_has,
    json_array_has_part,
)
from shared.catalog.photos import Photo, PhotoRole, has_given_place, is_geotagged, is_removed
from shared.ingest.photo_metadata import parse_time
from shared.place_paths import PATH_SEPARATOR
from shared.search_api.photo_filter import Box, Circle, PhotoFilter

# Upper limit of the total: the cost of a count grows with the number of matches.
MAX_COUNTED_MATCHES = 10_000
TRIGRAM_CHARACTERS = 3


class MetadataSearchParams(FilterParams, PageParams):
    """Query parameters of a metadata search; bounds are inclusive."""

    filename: str | None = Field(
        None,
        max_length=1000,
        pattern=NO_NUL_PATTERN,
        description="part of the file name or of `relative_path`, case-insensitive",
    )
    upload_after: str | None = Field(None, description="ISO 8601; no offset means UTC")
    upload_before: str | None = Field(None, description="ISO 8601; no offset means UTC")
    min_file_size: int | None = Field(None, ge=0, le=2**62)
    max_file_size: int | None = Field(None, ge=0, le=2**62)
    role: PhotoRole | None = Field(None, description="photos with this role; omitted: all")
    failed: bool = Field(
        False, description="photos that can't be searched for, because their description failed"
    )
    without_place: bool = Field(
        False, description="photos that have neither coordinates nor a place label"
    )
    place_given: bool = Field(
        False, description="photos whose place was given with `POST /places`, and not undone"
    )
    removed: bool = Field(False, description="photos in the trash, instead of those of the map")
    sort: Literal["added", "taken"] = Field(
        "added", description="newest first; `taken`: only photos whose time is known"
    )
    limit: int = Field(100, ge=1, le=1000)

    def conditions(self, photo: type[Photo] = Photo, *, trigrams: bool) -> list[Condition]:
        """Return the SQL conditions; 422 (`invalid_field`) names the invalid parameter.

        Args:
            trigrams: Whether the catalog has a trigram index (PostgreSQL).
        """
        conditions: list[Condition] = []
        if self.filename is not None:
            names = (photo.filename, photo.relative_path)
            conditions.append(
                or_(*(name.icontains(self.filename, autoescape=True) for name in names))
            )
            if trigrams and len(self.filename) >= TRIGRAM_CHARACTERS:
                part = filename_trigrams(literal(self.filename))
                conditions.append(or_(*(filename_trigrams(n).bool_op("@>")(part) for n in names)))
        if self.upload_after:
            conditions.append(photo.uploaded_at >= parse_time("upload_after", self.upload_after))
        if self.upload_before:
            conditions.append(photo.uploaded_at <= parse_time("upload_before", self.upload_before))
        if self.min_file_size is not None:
            conditions.append(photo.size_bytes >= self.min_file_size)
        if self.max_file_size is not None:
            conditions.append(photo.size_bytes <= self.max_file_size)
        if self.role is not None:
            conditions.append(photo.role == self.role)
        if self.without_place:
            conditions.append(~is_geotagged(photo))
        if self.place_given:
            conditions.append(has_given_place(photo))
        return conditions + filter_conditions(self.photo_filter(), photo)


def filter_conditions(photo_filter: PhotoFilter, photo: type[Photo] = Photo) -> list[Condition]:
    """Return the SQL conditions of the filter."""
    conditions: list[Condition] = []
    if photo_filter.near is not None:
        conditions += _circle_conditions(photo_filter.near, photo)
    if photo_filter.box is not None:
        conditions += _box_conditions(photo_filter.box, photo)
    if photo_filter.captured_after is not None:
        conditions.append(photo.captured_at >= photo_filter.captured_after)
    if photo_filter.captured_before is not None:
        conditions.append(photo.captured_at <= photo_filter.captured_before)
    if photo_filter.place is not None:
        conditions.append(photo.place == photo_filter.place)
    if photo_filter.place_under is not None:
        level = photo_filter.place_under
        below = level + PATH_SEPARATOR
        # Not LIKE, which ignores case in SQLite and in a path has wildcards to escape.
        conditions.append(
            or_(photo.place == level, func.substr(photo.place, 1, len(below)) == below)
        )
    if photo_filter.ids is not None:
        conditions.append(photo.id.in_(photo_filter.ids))
    if photo_filter.has_place:
        conditions.append(is_geotagged(photo))
    conditions.extend(json_array_has(photo.tags, tag) for tag in photo_filter.tags)
    conditions.extend(json_array_has_part(photo.tags, part) for part in photo_filter.tags_like)
    return conditions


def search_photos(
    session: Session,
    map_id: UUID,
    query: MetadataSearchParams,
    limit: int,
    after: tuple[datetime, UUID] | None,
) -> tuple[list[Photo], int]:
    """Search the live photos of a map, or those in its trash, newest first.

    Args:
        after: Cursor: upload time (or capture time) and id of the last photo of the previous page.

    Returns:
        A page of photos, and the total number of matches, counted up to MAX_COUNTED_MATCHES.
    """
    on_postgres = session.get_bind().dialect.name == "postgresql"
    is_there = is_removed() if query.removed else Photo.deleted_at.is_(None)
    live = [Photo.map_id == map_id, is_there]
    if query.failed:
        live.append(Photo.id.in_(select_failed_photos(map_id)))
    if query.sort == "taken":
        live.append(Photo.captured_at.is_not(None))
    conditions = [*live, *query.conditions(trigrams=on_postgres)]
    total = count_rows(session, select(Photo.id).where(*conditions), MAX_COUNTED_MATCHES)
    time = Photo.captured_at if query.sort == "taken" else Photo.uploaded_at
    newest = (time.desc(), Photo.id.desc())
    if after is not None:
        bound = tuple_(literal(after[0], UtcDateTime()), literal(after[1], Uuid()))
        live.append(tuple_(time, Photo.id) < bound)
    page: Select[Photo]
    if total < MAX_COUNTED_MATCHES:
        rare = select(Photo.id).where(*conditions).cte("rare")
        page = select(Photo).join(rare.prefix_with("MATERIALIZED"), rare.c.id == Photo.id)
        page = page.where(*live).order_by(*newest)
    elif not on_postgres:
        page = select(Photo).where(*live, *conditions).order_by(*newest)
    else:
        # OFFSET 0 keeps the conditions out of the subquery: inside, the planner may look them up in
        # their indexes and sort hundreds of thousands of rows.
        newest_first = select(Photo).where(*live).order_by(*newest).offset(0).subquery()
        scanned = aliased(Photo, newest_first)
        page = select(scanned).where(*query.conditions(scanned, trigrams=False))
        page = page.order_by(getattr(scanned, time.key).desc(), scanned.id.desc())
    return list(session.scalars(page.limit(limit))), total


def _circle_conditions(circle: Circle, photo: type[Photo]) -> list[Condition]:
    # The bounding box can use the index; the distance is exact.
    box = circle.bounding_box()
    distance = db_distance_m(
        literal(circle.latitude), literal(circle.longitude), photo.latitude, photo.longitude
    )
    conditions = [photo.latitude.between(box.south, box.north), distance <= circle.radius_m]
    if (box.west, box.east) != (-180.0, 180.0):
        conditions.append(or_(*_longitude_conditions(box, photo)))
    return conditions


def _box_conditions(box: Box, photo: type[Photo]) -> list[Condition]:
    at_a_pole = [func.abs(photo.latitude) == 90.0] if box.north == 90 or box.south == -90 else []
    return [
        photo.latitude.between(box.south, box.north),
        or_(*at_a_pole, *_longitude_conditions(box, photo)),
    ]


def _longitude_conditions(box: Box, photo: type[Photo]) -> list[Condition]:
    return [photo.longitude.between(west, east) for west, east in box.longitude_ranges()]
