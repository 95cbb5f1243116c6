"""How far each ranked photo was taken from its query."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.nearest import Indices
from shared.datasets.sets import Shot
from shared.geodesy import distance_m

Metres = NDArray[np.float64]


def metres_of(queries: Sequence[Shot], database: Sequence[Shot], ranked: Indices) -> Metres:
    """(queries, k) database indices -> (queries, k) metres, NaN where one has no position.

    Straight in the plane of the UTM zone that both lie in; over a zone's border by latitude and
    longitude, on the sphere.
    """
    asked, there = _Positions(queries), _Positions(database)
    metres: Metres = np.hypot(
        there.east[ranked] - asked.east[:, None], there.north[ranked] - asked.north[:, None]
    )
    other_zone = there.zone[ranked] != asked.zone[:, None]
    for query, place in zip(*np.nonzero(other_zone | np.isnan(metres)), strict=True):
        metres[query, place] = _over_the_border(queries[query], database[ranked[query, place]])
    return metres


class _Positions:
    """Easting and northing as arrays, NaN where not said."""

    def __init__(self, shots: Sequence[Shot]) -> None:
        self.east = np.array([np.nan if s.easting is None else s.easting for s in shots])
        self.north = np.array([np.nan if s.northing is None else s.northing for s in shots])
        self.zone = np.array([_plane(s.zone) for s in shots], dtype=np.str_)


def _plane(zone: str | None) -> str:
    """`32T` -> `32N`: letters of one half of the earth share their plane. No zone is one, too."""
    return f"{zone[:-1]}{'N' if zone[-1].upper() >= 'N' else 'S'}" if zone else ""


def _over_the_border(one: Shot, other: Shot) -> float:
    if None in (one.latitude, one.longitude, other.latitude, other.longitude):
        return float("nan")
    assert one.latitude is not None
    assert one.longitude is not None
    assert other.latitude is not None
    assert other.longitude is not None
    return distance_m(one.latitude, one.longitude, other.latitude, other.longitude)
