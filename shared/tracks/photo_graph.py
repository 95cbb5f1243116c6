"""The map as a filter sees it: photos, and which of them are near each other.

Photos with coordinates are near each other by their distance. For photos without, the map's own
sequences give the distances: photos taken one after the other are as far apart as a camera
moves at its typical speed between them, and photos with the same label show the same place.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shared.geodesy import EARTH_RADIUS_M

FloatArray = NDArray[np.float64]
ObjectArray = NDArray[np.object_]
Indices = NDArray[np.int64]

MAX_SAME_LABEL = 500
"""Number of photos that `PhotoGraph.around` finds by their labels alone, at most, in any one step
of a way"""


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
    seconds = np.nan_to_num(np.abs(signed_gap_seconds(sources, targets)), nan=np.inf)
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


def _objects(values: list[Any]) -> ObjectArray:
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column
