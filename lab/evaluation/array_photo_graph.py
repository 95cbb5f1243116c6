"""A photo graph over arrays, for evaluations of the track filter without a catalog."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import chain, islice

import numpy as np
from scipy.spatial import cKDTree

from shared.geodesy import EARTH_RADIUS_M
from shared.tracks import photo_graph
from shared.tracks.photo_graph import FloatArray, Indices, PhotoTable, unit_vectors

ROUNDING = 2e-15
"""Of the squared chord between two unit vectors"""


class ArrayPhotoGraph:
    """A photo graph over arrays, for evaluations; photos with coordinates are in a k-d tree.

    Args:
        table: All photos of the map.
    """

    def __init__(self, table: PhotoTable) -> None:
        self._table = table
        self._row_of = {photo: row for row, photo in enumerate(table.ids.tolist())}
        self._located = np.flatnonzero(~np.isnan(table.latitudes))
        self._tree = cKDTree(unit_vectors(table)[self._located])
        self._by_place: dict[str, list[int]] = {}
        self._by_sequence: dict[str, list[int]] = {}
        for row in np.flatnonzero(np.isnan(table.latitudes)).tolist():
            if table.places[row] is not None:
                self._by_place.setdefault(table.places[row], []).append(row)
            if table.sequences[row] is not None and not np.isnan(table.seconds[row]):
                self._by_sequence.setdefault(table.sequences[row], []).append(row)
        self._times: dict[str, FloatArray] = {}
        for name, rows in self._by_sequence.items():
            rows.sort(key=lambda row: float(table.seconds[row]))
            self._times[name] = table.seconds[rows]

    @property
    def photo_count(self) -> int:
        return len(self._table)

    def photos(self, ids: Sequence[str]) -> PhotoTable:
        rows = [row for photo in ids if (row := self._row_of.get(photo)) is not None]
        return self._table.take(np.array(rows, dtype=np.int64))

    def around(
        self, photos: PhotoTable, reach_m: float, reach_seconds: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        rows = {self._row_of[photo] for photo in photos.ids.tolist() if photo in self._row_of}
        located = ~np.isnan(photos.latitudes)
        found = self._within(photos.take(located), reach_m)
        # A way leads along a sequence, at a label to another sequence, and along that one.
        chain = rows - set(self._located.tolist()) if not located.all() else set()
        along: set[int] = set()
        if chain:
            chain |= self._same_label(chain)
            along = self._along_sequences(chain, reach_seconds)
            chain |= set(sorted(along)[:limit])
            chain |= self._same_label(chain)
        complete = max(len(found), len(along)) <= limit
        rows = set(found[:limit].tolist()) | chain
        return self._table.take(np.array(sorted(rows), dtype=np.int64)), complete

    def near(
        self, latitude: float, longitude: float, radius_m: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        point = PhotoTable.of_rows([("", latitude, longitude, None, None, None, None)])
        rows = self._within(point, radius_m)
        return self._table.take(rows[:limit]), len(rows) <= limit

    def count_labels(self, places: Collection[str]) -> Mapping[str, int]:
        return {place: len(self._by_place.get(place, ())) for place in places}

    def _within(self, points: PhotoTable, reach_m: float) -> Indices:
        """Return the sorted rows of the photos within the reach of any of the points."""
        chord = np.sqrt((reach_m / EARTH_RADIUS_M) ** 2 + ROUNDING)
        around = self._tree.query_ball_point(unit_vectors(points), chord)
        found: Indices = self._located[sorted(set(chain.from_iterable(around)))]
        return found

    def _same_label(self, rows: set[int]) -> set[int]:
        labels = {self._table.places[row] for row in rows} - {None}
        members = (row for label in sorted(labels) for row in self._by_place.get(label, []))
        return set(islice(members, photo_graph.MAX_SAME_LABEL))

    def _along_sequences(self, rows: set[int], reach_seconds: float) -> set[int]:
        found: set[int] = set()
        for row in rows:
            name, time = self._table.sequences[row], self._table.seconds[row]
            if name in self._times:
                first, last = np.searchsorted(
                    self._times[name],
                    [time - reach_seconds, np.nextafter(time + reach_seconds, np.inf)],
                )
                found.update(self._by_sequence[name][first:last])
        return found
