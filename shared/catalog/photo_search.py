"""Photos by what is known of them: conditions in SQL, and a page of those that meet them.

What is rare is looked up in an index of its condition and sorted; what is frequent is found by
walking through the newest photos. Counting first says which of the two it is, so that no page
depends on how well the planner guesses.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import Select, Uuid, func, literal, or_, select, tuple_
from sqlalchemy.orm import Session, aliased

from shared.catalog.base import (
    Condition,
    UtcDateTime,
    db_distance_m,
    filename_trigrams,
    json_array_has,
)
from shared.catalog.photos import Photo, PhotoRole
from shared.geodesy import latitude_bounds, longitude_half_width
from shared.search_api.photo_filter import NO_FILTER, Box, Circle, PhotoFilter

# Further than that nobody counts, nor turns pages: a count costs as much as it counts.
MAX_COUNTED_MATCHES = 10_000
TRIGRAM_CHARACTERS = 3


@dataclass(frozen=True, slots=True)
class MetadataFilter:
    """Conditions of a metadata search; None means "any". Bounds are inclusive."""

    filename: str | None = None
    """Part of the file name, case ignored; `%` and `_` are ordinary characters."""
    upload_after: datetime | None = None
    upload_before: datetime | None = None
    min_file_size: int | None = None
    max_file_size: int | None = None
    photos: PhotoFilter = NO_FILTER
    """Where, when and what the photo shows."""
    role: PhotoRole | None = None

    def conditions(self, photo: type[Photo] = Photo, *, trigrams: bool) -> list[Condition]:
        """The filter in SQL; `trigrams` where the catalog has an index of them."""
        found: list[Condition] = []
        if self.filename is not None:
            found.append(photo.filename.icontains(self.filename, autoescape=True))
            if trigrams and len(self.filename) >= TRIGRAM_CHARACTERS:
                part = filename_trigrams(literal(self.filename))
                found.append(filename_trigrams(photo.filename).bool_op("@>")(part))
        if self.upload_after is not None:
            found.append(photo.uploaded_at >= self.upload_after)
        if self.upload_before is not None:
            found.append(photo.uploaded_at <= self.upload_before)
        if self.min_file_size is not None:
            found.append(photo.size_bytes >= self.min_file_size)
        if self.max_file_size is not None:
            found.append(photo.size_bytes <= self.max_file_size)
        if self.role is not None:
            found.append(photo.role == self.role)
        return found + filter_conditions(self.photos, photo)


def filter_conditions(photo_filter: PhotoFilter, photo: type[Photo] = Photo) -> list[Condition]:
    """The filter in SQL."""
    found: list[Condition] = []
    if photo_filter.near is not None:
        found += _circle_conditions(photo_filter.near, photo)
    if photo_filter.box is not None:
        found += _box_conditions(photo_filter.box, photo)
    if photo_filter.captured_after is not None:
        found.append(photo.captured_at >= photo_filter.captured_after)
    if photo_filter.captured_before is not None:
        found.append(photo.captured_at <= photo_filter.captured_before)
    if photo_filter.place is not None:
        found.append(photo.place == photo_filter.place)
    if photo_filter.ids is not None:
        found.append(photo.id.in_(photo_filter.ids))
    found.extend(json_array_has(photo.tags, tag) for tag in photo_filter.tags)
    return found


def search_photos(
    session: Session,
    map_id: UUID,
    metadata_filter: MetadataFilter,
    limit: int,
    after: tuple[datetime, UUID] | None,
) -> tuple[list[Photo], int]:
    """Newest first: up to `limit` live photos after the cursor, and how many match in all, counted
    up to COUNTED_AT_MOST."""
    on_postgres = session.get_bind().dialect.name == "postgresql"
    live = [Photo.map_id == map_id, Photo.deleted_at.is_(None)]
    conditions = [*live, *metadata_filter.conditions(trigrams=on_postgres)]
    counted = select(literal(1)).select_from(Photo).where(*conditions).limit(MAX_COUNTED_MATCHES)
    total = session.scalar(select(func.count()).select_from(counted.subquery())) or 0
    newest = (Photo.uploaded_at.desc(), Photo.id.desc())
    if after is not None:
        live.append(tuple_(Photo.uploaded_at, Photo.id) < tuple_(*_cursor_bound(after)))
    page: Select[Photo]
    if total < MAX_COUNTED_MATCHES:
        rare = select(Photo.id).where(*conditions).cte("rare")
        page = select(Photo).join(rare.prefix_with("MATERIALIZED"), rare.c.id == Photo.id)
        page = page.where(*live).order_by(*newest)
    else:
        # An offset keeps the conditions outside: inside, the planner may look all of them up in an
        # index of theirs and sort hundreds of thousands.
        walked = select(Photo).where(*live).order_by(*newest).offset(0).subquery()
        seen = aliased(Photo, walked)
        page = select(seen).where(*metadata_filter.conditions(seen, trigrams=False))
        page = page.order_by(seen.uploaded_at.desc(), seen.id.desc())
    return list(session.scalars(page.limit(limit))), total


def _circle_conditions(circle: Circle, photo: type[Photo]) -> list[Condition]:
    south, north = latitude_bounds(circle.latitude, circle.radius_m)
    away = db_distance_m(
        literal(circle.latitude), literal(circle.longitude), photo.latitude, photo.longitude
    )
    found = [photo.latitude.between(south, north), away <= circle.radius_m]
    reach = longitude_half_width(circle.latitude, circle.radius_m)
    if reach is None or reach >= 180:
        return found
    # What the index can sort out by itself; the distance decides.
    west, east = circle.longitude - reach, circle.longitude + reach
    around = Box(
        south=south,
        west=west + 360 if west < -180 else west,
        north=north,
        east=east - 360 if east > 180 else east,
    )
    found.append(or_(*_longitude_conditions(around, photo)))
    return found


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
