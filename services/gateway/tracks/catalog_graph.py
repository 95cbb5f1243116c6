"""The photos of a map as the filter of a track sees them, read from the catalog.

The catalog knows no sequences: all photos of a map that have a time form one, so photos that were
taken within seconds of each other are near each other. That counts only for photos without
coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from uuid import UUID

import numpy as np
from sqlalchemy import and_, or_, select
from sqlalchemy.orm import Session

from shared.catalog.base import Condition
from shared.catalog.maps import CachedMapStatistics
from shared.catalog.photo_search import filter_conditions
from shared.catalog.photos import Photo, PhotoRole, count_live_photos
from shared.geodesy import distances_m
from shared.search_api.photo_filter import Circle, PhotoFilter
from shared.tracks.photo_graph import PhotoTable

CELL_DEGREES = 0.001  # sources within a cell of this size share one condition
CONDITIONS_PER_QUERY = 100
SEQUENCE = "map"
"""Name of the sequence of all photos that have a time."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
MIN_SECONDS = (datetime.min.replace(tzinfo=UTC) - EPOCH).total_seconds()
MAX_SECONDS = (datetime.max.replace(tzinfo=UTC) - EPOCH).total_seconds() - 1


class CatalogPhotoGraph:
    """`shared.tracks.photo_graph.PhotoGraph` of the live photos of a map."""

    def __init__(self, session: Session, map_id: UUID) -> None:
        self._session = session
        self._map_id = map_id

    @property
    def photo_count(self) -> int:
        """Number of photos; of a large map, as of the last count."""
        cached = self._session.get(CachedMapStatistics, self._map_id)
        if cached is not None:
            return int(cached.figures["photos"])
        return count_live_photos(self._session, self._map_id, PhotoRole.DATABASE)

    def photos(self, ids: Sequence[str]) -> PhotoTable:
        """Return the photos that have one of these ids and are still in the map."""
        return self._select([Photo.id.in_([UUID(photo_id) for photo_id in ids])])

    def near(self, latitude: float, longitude: float, radius_m: float) -> PhotoTable:
        """Return the photos with coordinates within a radius."""
        return self._select([_within(latitude, longitude, radius_m)])

    def labelled(self, place: str) -> PhotoTable:
        """Return the photos with exactly this place label."""
        return self._select([Photo.place == place])

    def around(self, photos: PhotoTable, reach_m: float, reach_seconds: float) -> PhotoTable:
        """Return all photos near any of `photos`; see `PhotoGraph.around`."""
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
        cells: dict[tuple[int, int], list[int]] = {}
        for row, (latitude, longitude) in enumerate(
            zip(points.latitudes, points.longitudes, strict=True)
        ):
            cell = (int(latitude // CELL_DEGREES), int(longitude // CELL_DEGREES))
            cells.setdefault(cell, []).append(row)
        conditions = []
        for rows in cells.values():
            latitude, longitude = points.latitudes[rows[0]], points.longitudes[rows[0]]
            spread_m = distances_m(
                latitude, longitude, points.latitudes[rows], points.longitudes[rows]
            ).max()
            conditions.append(_within(latitude, longitude, float(reach_m + spread_m)))
        found = self._select(conditions)
        distance_m = np.full(len(found), np.inf)
        for latitude, longitude in zip(points.latitudes, points.longitudes, strict=True):
            to_point = distances_m(latitude, longitude, found.latitudes, found.longitudes)
            np.minimum(distance_m, to_point, out=distance_m)
        return found.take(distance_m <= reach_m)

    def _same_label(self, photos: PhotoTable) -> PhotoTable:
        labels = sorted({place for place in photos.places.tolist() if place is not None})
        return self._select([and_(Photo.place.in_(labels), Photo.latitude.is_(None))])

    def _taken_within(self, photos: PhotoTable, reach_seconds: float) -> PhotoTable:
        intervals: list[tuple[float, float]] = []
        for second in np.sort(photos.seconds[~np.isnan(photos.seconds)]).tolist():
            if intervals and second - reach_seconds <= intervals[-1][1]:
                intervals[-1] = (intervals[-1][0], second + reach_seconds)
            else:
                intervals.append((second - reach_seconds, second + reach_seconds))
        return self._select(
            [
                and_(
                    Photo.captured_at.between(_to_time(first), _to_time(last)),
                    Photo.latitude.is_(None),
                )
                for first, last in intervals
            ]
        )

    def _select(self, any_of: Sequence[Condition]) -> PhotoTable:
        """Return the photos that match any of the conditions, each once."""
        tables = [PhotoTable.of_rows([])]
        for begin in range(0, len(any_of), CONDITIONS_PER_QUERY):
            rows = self._session.execute(
                select(
                    Photo.id,
                    Photo.latitude,
                    Photo.longitude,
                    Photo.heading,
                    Photo.place,
                    Photo.captured_at,
                ).where(
                    Photo.deleted_at.is_(None),
                    Photo.role == PhotoRole.DATABASE,
                    # In each alternative, so that each uses an index, which begins with the map.
                    or_(
                        *(
                            and_(Photo.map_id == self._map_id, condition)
                            for condition in any_of[begin : begin + CONDITIONS_PER_QUERY]
                        )
                    ),
                )
            )
            tables.append(
                PhotoTable.of_rows(
                    (
                        str(photo_id),
                        latitude,
                        longitude,
                        heading,
                        place,
                        None if taken is None else SEQUENCE,
                        None if taken is None else taken.timestamp(),
                    )
                    for photo_id, latitude, longitude, heading, place, taken in rows
                )
            )
        return tables[0].union(*tables[1:])


def _within(latitude: float, longitude: float, radius_m: float) -> Condition:
    circle = Circle(latitude=float(latitude), longitude=float(longitude), radius_m=radius_m)
    return and_(*filter_conditions(PhotoFilter(near=circle)))


def _to_time(seconds: float) -> datetime:
    return EPOCH + timedelta(seconds=min(max(seconds, MIN_SECONDS), MAX_SECONDS))
