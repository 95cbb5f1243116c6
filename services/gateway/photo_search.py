"""Metadata search: photo filters as SQL conditions, and pages of matching photos.

Rare matches are looked up in an index of their conditions and sorted; frequent ones are found by
scanning from the newest photo. The matches are counted first to choose between the two, so that the
plan does not depend on the estimates of the planner.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import Select, Uuid, func, literal, or_, select, tuple_
from sqlalchemy.orm import Session, aliased

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
from shared.place_paths import PATH_SEPARATOR
from shared.search_api.photo_filter import NO_FILTER, Box, Circle, PhotoFilter

# Upper limit of the total: the cost of a count grows with the number of matches.
MAX_COUNTED_MATCHES = 10_000
TRIGRAM_CHARACTERS = 3


@dataclass(frozen=True, slots=True)
class MetadataFilter:
    """Conditions of a metadata search; None means "any". Bounds are inclusive."""

    filename: str | None = None
    """Substring of the file name or the relative path, case-insensitive; `%` and `_` are ordinary
    characters."""
    upload_after: datetime | None = None
    upload_before: datetime | None = None
    min_file_size: int | None = None
    max_file_size: int | None = None
    photos: PhotoFilter = NO_FILTER
    """Filter by location, time, place and tags."""
    role: PhotoRole | None = None
    failed: bool = False
    """Whether the photo's description has to have failed."""
    without_place: bool = False
    """Whether the photo must have neither coordinates nor a label."""
    place_given: bool = False
    """Whether the photo's place must have been given here."""
    removed: bool = False
    """Whether the photo must be in the trash, instead of live."""
    by_capture: bool = False
    """Whether photos are sorted by when they were taken, and have to be dated."""

    def conditions(self, photo: type[Photo] = Photo, *, trigrams: bool) -> list[Condition]:
        """Return the SQL conditions; `trigrams` if the catalog has a trigram index (PostgreSQL)."""
        conditions: list[Condition] = []
        if self.filename is not None:
            names = (photo.filename, photo.relative_path)
            conditions.append(
                or_(*(name.icontains(self.filename, autoescape=True) for name in names))
            )
            if trigrams and len(self.filename) >= TRIGRAM_CHARACTERS:
                part = filename_trigrams(literal(self.filename))
                conditions.append(or_(*(filename_trigrams(n).bool_op("@>")(part) for n in names)))
        if self.upload_after is not None:
            conditions.append(photo.uploaded_at >= self.upload_after)
        if self.upload_before is not None:
            conditions.append(photo.uploaded_at <= self.upload_before)
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
        return conditions + filter_conditions(self.photos, photo)


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
    metadata_filter: MetadataFilter,
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
    is_there = is_removed() if metadata_filter.removed else Photo.deleted_at.is_(None)
    live = [Photo.map_id == map_id, is_there]
    if metadata_filter.failed:
        live.append(Photo.id.in_(select_failed_photos(map_id)))
    if metadata_filter.by_capture:
        live.append(Photo.captured_at.is_not(None))
    conditions = [*live, *metadata_filter.conditions(trigrams=on_postgres)]
    total = count_rows(session, select(Photo.id).where(*conditions), MAX_COUNTED_MATCHES)
    time = Photo.captured_at if metadata_filter.by_capture else Photo.uploaded_at
    newest = (time.desc(), Photo.id.desc())
    if after is not None:
        live.append(tuple_(time, Photo.id) < tuple_(*_cursor_bound(after)))
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
        page = select(scanned).where(*metadata_filter.conditions(scanned, trigrams=False))
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


def _cursor_bound(after: tuple[datetime, UUID]) -> tuple[object, object]:
    return literal(after[0], UtcDateTime()), literal(after[1], Uuid())
