"""The photos of a map as the filter of a track sees them, read from the catalog.

The catalog has no sequences: all photos of a map that have a time form one, so photos that were
taken within seconds of each other are near each other. That counts only for photos without
coordinates.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import (
    ColumnElement,
    Float,
    Select,
    and_,
    cast,
    func,
    literal,
    literal_column,
    or_,
    select,
)
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import Session

from shared.catalog.database.base import Condition
from shared.catalog.maps import CachedMapStatistics
from shared.catalog.photos import Photo, PhotoRole, count_live_photos
from shared.geodesy import EARTH_RADIUS_M, distances_m, latitude_bounds, longitude_half_width
from shared.tracks.photo_graph import MAX_SAME_LABEL, PhotoTable

CELL_DEGREES = 0.001  # least height of the strips in which photos are looked up together
INTERVALS_PER_QUERY = 100
MAX_COUNTED = 50_000
"""Number of photos that are counted to learn how many have a label."""
COLUMNS = (
    Photo.id,
    Photo.latitude,
    Photo.longitude,
    Photo.heading,
    Photo.place,
    Photo.captured_at,
)
SEQUENCE = "map"
"""Name of the sequence of all photos that have a time."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
MIN_SECONDS = (datetime.min.replace(tzinfo=UTC) - EPOCH).total_seconds()
MAX_SECONDS = (datetime.max.replace(tzinfo=UTC) - EPOCH).total_seconds() - 1

PhotoRow = tuple[
    str, float | None, float | None, float | None, str | None, str | None, float | None
]
"""A row of a `PhotoTable`."""
Box = tuple[float, float, float, float]
"""South, north, west, east in degrees; west is not greater than east."""


class CatalogPhotoGraph:
    """`shared.tracks.photo_graph.PhotoGraph` of the live photos of a map, as of one session.

    Photos that were read before are not read again: frames of a track show the same ones.
    """

    def __init__(self, session: Session, map_id: UUID) -> None:
        self._session = session
        self._map_id = map_id
        self._read: dict[str, PhotoRow | None] = {}

    @cached_property
    def photo_count(self) -> int:
        """Number of photos; of a large map, as of the last count."""
        cached = self._session.get(CachedMapStatistics, self._map_id)
        if cached is not None:
            return int(cached.figures["photos"])
        return count_live_photos(self._session, self._map_id, PhotoRole.DATABASE)

    def photos(self, ids: Sequence[str]) -> PhotoTable:
        """Return the photos that have one of these ids and are still in the map."""
        unread = [photo_id for photo_id in ids if photo_id not in self._read]
        if unread:
            self._read.update(dict.fromkeys(unread))
            # Without the map, to which they belong: SQLite would scan its photos.
            self._select(Photo.id.in_([UUID(photo_id) for photo_id in unread]))
        rows = (self._read[photo_id] for photo_id in ids)
        return PhotoTable.of_rows(row for row in rows if row is not None)

    def near(
        self, latitude: float, longitude: float, radius_m: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        """Return up to `limit` photos with coordinates within a radius, and whether all."""
        boxes = _boxes_around(latitude, longitude, radius_m)
        found, is_all = self._inside(boxes, limit)
        away = distances_m(latitude, longitude, found.latitudes, found.longitudes)
        return found.take(away <= radius_m), is_all

    def count_labels(self, places: Collection[str]) -> Mapping[str, int]:
        """Return the number of photos without coordinates that have each of these labels.

        They are counted up to MAX_COUNTED, for all labels together.
        """
        rows = (
            _live_photos(Photo.place)
            .where(
                Photo.map_id == self._map_id,
                Photo.place.in_(sorted(places)),
                Photo.latitude.is_(None),
            )
            .limit(MAX_COUNTED)
            .subquery()
        )
        counts = self._session.execute(select(rows.c.place, func.count()).group_by(rows.c.place))
        return dict.fromkeys(places, 0) | {place: int(count) for place, count in counts}

    def around(
        self, photos: PhotoTable, reach_m: float, reach_seconds: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        """Return the photos near any of `photos`, and whether all; see `PhotoGraph.around`.

        Some that are a little farther than `reach_m` are among them.
        """
        located = ~np.isnan(photos.latitudes)
        found, is_all = self._around_points(photos.take(located), reach_m, limit)
        if located.all():
            return found, is_all
        # A way leads along a sequence, at a label to another place of it, and along it again.
        chain = photos.take(~located)
        chain = chain.union(self._same_label(chain))
        along, is_all_along = self._taken_within(chain, reach_seconds, limit)
        chain = chain.union(along)
        chain = chain.union(self._same_label(chain))
        return found.union(chain), is_all and is_all_along

    def _around_points(
        self, points: PhotoTable, reach_m: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        # In strips of the map: boxes around the points would overlap, and find a photo many times.
        height = max(CELL_DEGREES, math.degrees(reach_m / EARTH_RADIUS_M))
        strips: dict[int, list[tuple[float, float]]] = {}
        for latitude, longitude in zip(points.latitudes, points.longitudes, strict=True):
            for south, north, west, east in _boxes_around(latitude, longitude, reach_m):
                for strip in range(int(south // height), int(north // height) + 1):
                    strips.setdefault(strip, []).append((west, east))
        boxes = [
            (strip * height, (strip + 1) * height, west, east)
            for strip, intervals in strips.items()
            for west, east in _merge(intervals)
        ]
        return self._inside(boxes, limit)

    def _inside(self, boxes: Sequence[Box], limit: int) -> tuple[PhotoTable, bool]:
        """Return up to `limit` photos inside any of the boxes, and whether all."""
        # The boxes are one parameter: building and parsing a condition for each takes far longer.
        sides: list[ColumnElement[float]]
        if self._session.get_bind().dialect.name == "postgresql":
            rows = func.jsonb_array_elements(literal(list(boxes), JSONB)).table_valued("value")
            sides = [cast(rows.c.value.op("->>")(literal_column(str(i))), Float) for i in range(4)]
        else:
            rows = func.json_each(json.dumps(boxes)).table_valued("value")
            sides = [func.json_extract(rows.c.value, f"$[{i}]") for i in range(4)]
        south, north, west, east = sides
        # An outer join, because SQLite would scan the photos of the map for an inner one.
        found = self._session.execute(
            select(*COLUMNS)
            .select_from(rows)
            .outerjoin(
                Photo,
                and_(
                    Photo.map_id == self._map_id,
                    Photo.latitude.between(south, north),
                    Photo.longitude.between(west, east),
                    Photo.deleted_at.is_(None),
                    Photo.role == PhotoRole.DATABASE,
                ),
            )
            .limit(limit + 1 + len(boxes))  # a box without photos is a row, too
        )
        # A photo on the border of two boxes is two rows, of which the limit counts both.
        photos = [row for row in found if row.id]
        table = self._table(photos)
        return table.take(np.arange(min(len(table), limit))), len(photos) <= limit

    def _same_label(self, photos: PhotoTable) -> PhotoTable:
        labels = sorted({place for place in photos.places.tolist() if place is not None})
        return self._select(
            Photo.map_id == self._map_id,
            Photo.place.in_(labels),
            Photo.latitude.is_(None),
            limit=MAX_SAME_LABEL,
        )

    def _taken_within(
        self, photos: PhotoTable, reach_seconds: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        seconds = photos.seconds[~np.isnan(photos.seconds)].tolist()
        intervals = _merge((each - reach_seconds, each + reach_seconds) for each in seconds)
        # The map in each alternative, so that each uses an index, which begins with it.
        alternatives = [
            and_(
                Photo.map_id == self._map_id,
                Photo.captured_at.between(_to_time(first), _to_time(last)),
            )
            for first, last in intervals
        ]
        found = photos.take(np.zeros(0, dtype=np.int64))
        for begin in range(0, len(alternatives), INTERVALS_PER_QUERY):
            any_of = or_(*alternatives[begin : begin + INTERVALS_PER_QUERY])
            room = limit + 1 - len(found)
            found = found.union(self._select(any_of, Photo.latitude.is_(None), limit=room))
            if len(found) > limit:
                return found.take(np.arange(limit)), False
        return found, True

    def _select(self, *conditions: Condition, limit: int | None = None) -> PhotoTable:
        rows = self._session.execute(_live_photos(*COLUMNS).where(*conditions).limit(limit))
        return self._table(rows)

    def _table(self, rows: Iterable[Any]) -> PhotoTable:
        """Return the photos of rows of COLUMNS, each once."""
        found: dict[str, PhotoRow] = {}
        for photo_id, latitude, longitude, heading, place, taken in rows:
            name, seconds = (None, None) if taken is None else (SEQUENCE, taken.timestamp())
            key = str(photo_id)
            found[key] = (key, latitude, longitude, heading, place, name, seconds)
        self._read.update(found)
        return PhotoTable.of_rows(found.values())


def _live_photos(*columns: Any) -> Select[Any]:
    return select(*columns).where(Photo.deleted_at.is_(None), Photo.role == PhotoRole.DATABASE)


def _boxes_around(latitude: float, longitude: float, margin_m: float) -> list[Box]:
    """Return boxes that contain all points within a margin of a point."""
    low, high = map(float, latitude_bounds(latitude, margin_m))
    width = longitude_half_width(latitude, margin_m)
    if width is None:
        return [(low, high, -180.0, 180.0)]
    west, east = float(longitude - width), float(longitude + width)
    parts = [(west, east), (west + 360, 180.0), (-180.0, east - 360)]
    return [(low, high, a, b) for a, b in parts if a <= b and a <= 180 and b >= -180]


def _merge(intervals: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return intervals in ascending order, those that overlap as one."""
    merged: list[tuple[float, float]] = []
    for first, last in sorted(intervals):
        if merged and first <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(last, merged[-1][1]))
        else:
            merged.append((first, last))
    return merged


def _to_time(seconds: float) -> datetime:
    return EPOCH + timedelta(seconds=min(max(seconds, MIN_SECONDS), MAX_SECONDS))
