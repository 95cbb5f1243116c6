"""How far two photos of each pair were taken from each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared.datasets.shots import Shot
from shared.datasets.zones import degrees_of, positions_of
from shared.geodesy import distance_m


def metres_apart(some: Sequence[Shot], others: Sequence[Shot]) -> NDArray[np.float64]:
    """(n,) metres between the photos of each pair, NaN where one has no position.

    Straight in the plane of the UTM zone that both lie in; over a zone's border on the sphere.
    """
    metres = np.full(len(some), np.nan)
    placed = [
        number
        for number, pair in enumerate(zip(some, others, strict=True))
        if all(has_position(shot) for shot in pair)
    ]
    here, zones = positions_of([some[number] for number in placed])
    there, other_zones = positions_of([others[number] for number in placed])
    metres[placed] = np.hypot(*(there - here).T)
    for index, number in enumerate(placed):
        zone, other = zones[index], other_zones[index]
        if zone != other and zone is not None and other is not None:
            metres[number] = distance_m(
                *degrees_of(zone, here[index]), *degrees_of(other, there[index])
            )
    return metres


def has_position(shot: Shot) -> bool:
    return None not in (shot.easting, shot.northing) or None not in (shot.latitude, shot.longitude)
