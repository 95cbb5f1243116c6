"""The photos of a map as the filter of a track sees them, read from the catalog.

The catalog has no sequences: all photos of a map that have a time form one, so photos that were
taken within seconds of each other are near each other. That counts only for photos without
coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import ColumnElement, Float, and_, cast, func, literal, literal_column, or_, select
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import Session

from shared.catalog.database.base import Condition
from shared.catalog.maps import CachedMapStatistics
from shared.catalog.photos import Photo, PhotoRole, count_live_photos
from shared.geodesy import distances_m, latitude_bounds, longitude_half_width
from shared.tracks.photo_graph import PhotoTable

CELL_DEGREES = 0.001  # photos within a cell of this size are looked up together
INTERVALS_PER_QUERY = 100
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

    def near(self, latitude: float, longitude: float, radius_m: float) -> PhotoTable:
        """Return the photos with coordinates within a radius."""
        found = self._inside(_boxes_around(latitude, latitude, longitude, longitude, radius_m))
        away = distances_m(latitude, longitude, found.latitudes, found.longitudes)
        return found.take(away <= radius_m)

    def labelled(self, place: str) -> PhotoTable:
        """Return the photos with exactly this place label."""
        return self._select(Photo.map_id == self._map_id, Photo.place == place)

    def around(self, photos: PhotoTable, reach_m: float, reach_seconds: float) -> PhotoTable:
        """Return all photos near any of `photos`; see `PhotoGraph.around`.

        Some that are a little farther than `reach_m` are among them.
        """
        located = ~np.isnan(photos.latitudes)
        found = self._around_points(photos.take(located), reach_m)
        if located.all():
            return found
        # A way leads along a sequence, at a label to another place of it, and along it again.
        chain = photos.take(~located)
        chain = chain.union(self._same_label(chain))
        chain = chain.union(self._taken_within(chain, reach_seconds))
        chain = chain.union(self._same_label(chain))
        return found.union(chain)

    def _around_points(self, points: PhotoTable, reach_m: float) -> PhotoTable:
        cells: dict[tuple[float, float], list[int]] = {}
        for row, cell in enumerate(
            zip(points.latitudes // CELL_DEGREES, points.longitudes // CELL_DEGREES, strict=True)
        ):
            cells.setdefault(cell, []).append(row)
        boxes: list[Box] = []
        for rows in cells.values():
            latitudes, longitudes = points.latitudes[rows], points.longitudes[rows]
            boxes += _boxes_around(
                latitudes.min(), latitudes.max(), longitudes.min(), longitudes.max(), reach_m
            )
        return self._inside(boxes)

    def _inside(self, boxes: Sequence[Box]) -> PhotoTable:
        """Return the photos inside any of the boxes."""
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
        )
        return self._table(row for row in found if row.id)

    def _same_label(self, photos: PhotoTable) -> PhotoTable:
        labels = sorted({place for place in photos.places.tolist() if place is not None})
        return self._select(
            Photo.map_id == self._map_id, Photo.place.in_(labels), Photo.latitude.is_(None)
        )

    def _taken_within(self, photos: PhotoTable, reach_seconds: float) -> PhotoTable:
        intervals: list[tuple[float, float]] = []
        for second in np.sort(photos.seconds[~np.isnan(photos.seconds)]).tolist():
            if intervals and second - reach_seconds <= intervals[-1][1]:
                intervals[-1] = (intervals[-1][0], second + reach_seconds)
            else:
                intervals.append((second - reach_seconds, second + reach_seconds))
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
            found = found.union(self._select(any_of, Photo.latitude.is_(None)))
        return found

    def _select(self, *conditions: Condition) -> PhotoTable:
        rows = self._session.execute(
            select(*COLUMNS).where(
                Photo.deleted_at.is_(None), Photo.role == PhotoRole.DATABASE, *conditions
            )
        )
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


def _boxes_around(
    south: float, north: float, west: float, east: float, margin_m: float
) -> list[Box]:
    """Return boxes that contain a box and all points within a margin of it."""
    low, high = latitude_bounds(south, margin_m)[0], latitude_bounds(north, margin_m)[1]
    width = longitude_half_width(max(abs(south), abs(north)), margin_m)
    if width is None:
        return [(float(low), float(high), -180.0, 180.0)]
    west, east = float(west - width), float(east + width)
    parts = [(west, east), (west + 360, 180.0), (-180.0, east - 360)]
    return [(float(low), float(high), a, b) for a, b in parts if a <= b and a <= 180 and b >= -180]


def _to_time(seconds: float) -> datetime:
    return EPOCH + timedelta(seconds=min(max(seconds, MIN_SECONDS), MAX_SECONDS))
