"""The map as a filter sees it: photos, and which of them are near each other.

Photos with coordinates are near each other by their distance. For photos without, the map's own
sequences give the distances: photos taken one after the other are as far apart as a camera
moves at its typical speed between them, and photos with the same label show the same place.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shared.geodesy import EARTH_RADIUS_M

FloatArray = NDArray[np.float64]
ObjectArray = NDArray[np.object_]
Indices = NDArray[np.int64]

CELL_M = 100.0
MAX_GRID_REACH_M = 2000.0
"""Farther away, the cells of `ArrayPhotoGraph` would be more than the photos"""
MAX_SAME_LABEL = 500
"""Number of photos that `PhotoGraph.around` finds by their labels alone, at most, in any one step
of a way"""
_OFFSET, _AXIS = 1 << 19, 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class PhotoTable:
    """Photos of a map, one row each."""

    ids: ObjectArray
    """(n,) str, unique"""
    latitudes: FloatArray
    """(n,) degrees; NaN if unknown"""
    longitudes: FloatArray
    headings: FloatArray
    """(n,) degrees clockwise from north; NaN if unknown"""
    places: ObjectArray
    """(n,) labels, str or None"""
    sequences: ObjectArray
    """(n,) names of sequences, str or None. Times of different sequences are not compared."""
    seconds: FloatArray
    """(n,) time within the sequence; NaN if unknown"""

    @classmethod
    def of_rows(
        cls,
        rows: Iterable[
            tuple[
                str, float | None, float | None, float | None, str | None, str | None, float | None
            ]
        ],
    ) -> PhotoTable:
        """Build a table from rows of id, latitude, longitude, heading, place, sequence, seconds."""
        columns: list[list[Any]] = [list(column) for column in zip(*rows, strict=True)] or [
            [] for _ in cls.__slots__
        ]
        ids, latitudes, longitudes, headings, places, sequences, seconds = columns
        return cls(
            _objects(ids),
            np.array(latitudes, dtype=np.float64),
            np.array(longitudes, dtype=np.float64),
            np.array(headings, dtype=np.float64),
            _objects(places),
            _objects(sequences),
            np.array(seconds, dtype=np.float64),
        )

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: NDArray[Any]) -> PhotoTable:
        """Return the rows at indices, or under a mask."""
        return PhotoTable(*(getattr(self, name)[rows] for name in self.__slots__))

    def union(self, *others: PhotoTable) -> PhotoTable:
        """Return the rows of this table, followed by those of the others that it lacks."""
        tables = [self, *others]
        joined = PhotoTable(
            *(np.concatenate([getattr(table, name) for table in tables]) for name in self.__slots__)
        )
        first: dict[str, int] = {}
        for row, photo in enumerate(joined.ids.tolist()):
            first.setdefault(photo, row)
        return joined.take(np.fromiter(first.values(), np.int64, len(first)))


class PhotoGraph(Protocol):
    """Access to the photos of a map. All methods return each photo once, in any order."""

    @property
    def photo_count(self) -> int:
        """Number of searchable photos of the map."""
        ...

    def photos(self, ids: Sequence[str]) -> PhotoTable:
        """Return the photos that have one of these ids and are still in the map."""
        ...

    def around(
        self, photos: PhotoTable, reach_m: float, reach_seconds: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        """Return the photos near any of `photos`, which may be among them, and whether all.

        Near are those with coordinates within `reach_m`; those of the same sequence within
        `reach_seconds`, if one of both photos has no coordinates; and up to MAX_SAME_LABEL that
        have a label in common with a photo without coordinates that is found. Where more than
        `limit` are near by coordinates or by time, any of them.
        """
        ...

    def near(
        self, latitude: float, longitude: float, radius_m: float, limit: int
    ) -> tuple[PhotoTable, bool]:
        """Return up to `limit` photos with coordinates within a radius, and whether all."""
        ...

    def count_labels(self, places: Collection[str]) -> Mapping[str, int]:
        """Return the number of photos without coordinates that have each of these labels."""
        ...


def distance_matrix_m(
    sources: PhotoTable, targets: PhotoTable, typical_speed_mps: float
) -> FloatArray:
    """Return (n, m) distances in metres from source photos to target photos.

    It is the distance of their coordinates, or else the time between them in their sequence at the
    typical speed. Photos with the same label, of which one has no coordinates, are 0 m apart, and
    paths may change the sequence at such a label. Infinite where no way is known.
    """
    a, b = unit_vectors(sources), unit_vectors(targets)
    # The squares are computed around a point nearby; around the Earth's centre they lose metres.
    near = b[~np.isnan(targets.latitudes)][:1].sum(axis=0)
    a, b = a - near, b - near
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None, :] - 2 * (a @ b.T)
    distances: FloatArray = EARTH_RADIUS_M * np.sqrt(np.maximum(0.0, squares))
    unknown = np.isnan(distances)
    if not unknown.any():
        return distances
    travel = _travel_seconds(sources, targets) * typical_speed_mps
    return np.where(unknown, travel, distances)


def unit_vectors(photos: PhotoTable) -> FloatArray:
    """Return (n, 3) unit vectors from the Earth's centre; NaN without coordinates."""
    phi, lam = np.radians(photos.latitudes), np.radians(photos.longitudes)
    return np.stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], axis=1)


def _travel_seconds(sources: PhotoTable, targets: PhotoTable) -> FloatArray:
    """Return (n, m) seconds along the sequences, where the same label is the same place."""
    seconds = _gap_seconds(sources, targets)
    labels = [label for label in set(targets.places.tolist()) if label is not None]
    if not labels:
        return seconds
    # From a photo to a label: over the nearest photo of its sequence that has the label.
    for label in labels:
        members = targets.take(targets.places == label)
        leave, arrive = _nearest_seconds(sources, members), _nearest_seconds(targets, members)
        leave[sources.places == label] = 0.0
        arrive[targets.places == label] = 0.0
        np.minimum(seconds, leave[:, None] + arrive[None, :], out=seconds)
    return seconds


def _nearest_seconds(photos: PhotoTable, members: PhotoTable) -> FloatArray:
    """Return (n,) seconds from each photo to the nearest of `members` in its sequence, if any."""
    nearest = np.full(len(photos), np.inf)
    for name in set(members.sequences.tolist()) - {None}:
        times = np.sort(members.seconds[members.sequences == name])
        times = times[~np.isnan(times)]
        rows = np.flatnonzero((photos.sequences == name) & ~np.isnan(photos.seconds))
        if len(times):
            seconds = photos.seconds[rows]
            after = np.searchsorted(times, seconds).clip(1, len(times) - 1) if len(times) > 1 else 0
            nearest[rows] = np.minimum(abs(times[after] - seconds), abs(times[after - 1] - seconds))
    return nearest


def _gap_seconds(a: PhotoTable, b: PhotoTable) -> FloatArray:
    """Return (n, m) seconds between photos of the same sequence; infinite for others."""
    return np.nan_to_num(np.abs(signed_gap_seconds(a, b)), nan=np.inf)


def signed_gap_seconds(a: PhotoTable, b: PhotoTable) -> FloatArray:
    """Return (n, m) seconds from each photo of `a` to each of `b`, negative where that is earlier.

    NaN for photos of different sequences.
    """
    codes = {name: code for code, name in enumerate(set(a.sequences) | set(b.sequences))}
    left = np.array([codes[name] for name in a.sequences], dtype=np.int64)
    right = np.array([codes[name] for name in b.sequences], dtype=np.int64)
    comparable = left[:, None] == right[None, :]
    if None in codes:
        comparable &= (left != codes[None])[:, None]
    return np.where(comparable, b.seconds[None, :] - a.seconds[:, None], np.nan)


class ArrayPhotoGraph:
    """A photo graph over arrays, for evaluations; photos with coordinates lie in a grid of cells.

    Args:
        table: All photos of the map.
    """

    def __init__(self, table: PhotoTable) -> None:
        self._table = table
        self._row_of = {photo: row for row, photo in enumerate(table.ids.tolist())}
        cells = _cells(table)
        located = np.flatnonzero(~np.isnan(table.latitudes))
        keys = _cell_keys(cells[located])
        order = np.argsort(keys, kind="stable")
        self._located, self._keys = located[order], keys[order]
        self._vectors = unit_vectors(table)
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
        if not len(points) or not len(self._located):
            return np.zeros(0, dtype=np.int64)
        if reach_m > MAX_GRID_REACH_M:
            return self._near_any(points, np.sort(self._located), reach_m)
        steps = int(np.ceil(reach_m / CELL_M))
        axis = np.arange(-steps, steps + 1)
        shifts = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        cells = np.unique(_cells(points), axis=0)
        keys = np.unique(_cell_keys((cells[:, None] + shifts[None]).reshape(-1, 3)))
        starts, ends = (np.searchsorted(self._keys, keys, side) for side in ("left", "right"))
        rows = [self._located[a:b] for a, b in zip(starts, ends, strict=True) if b > a]
        candidates = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
        return self._near_any(points, np.sort(candidates), reach_m)

    def _near_any(self, points: PhotoTable, candidates: Indices, reach_m: float) -> Indices:
        cosines = self._vectors[candidates] @ unit_vectors(points).T
        limit = 1 - (reach_m / EARTH_RADIUS_M) ** 2 / 2 - 1e-15
        found: Indices = candidates[cosines.max(axis=1, initial=-1.0) >= limit]
        return found

    def _same_label(self, rows: set[int]) -> set[int]:
        labels = {self._table.places[row] for row in rows} - {None}
        members = (row for label in sorted(labels) for row in self._by_place.get(label, []))
        return set(islice(members, MAX_SAME_LABEL))

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


def _cells(photos: PhotoTable) -> Indices:
    """Return (n, 3) cells of CELL_M of photos with coordinates."""
    cells = np.floor(np.nan_to_num(unit_vectors(photos)) * (EARTH_RADIUS_M / CELL_M))
    return cells.astype(np.int64)


def _cell_keys(cells: Indices) -> Indices:
    shifted = cells + _OFFSET
    keys: Indices = (shifted[:, 0] * _AXIS + shifted[:, 1]) * _AXIS + shifted[:, 2]
    return keys


def _objects(values: list[Any]) -> ObjectArray:
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column
