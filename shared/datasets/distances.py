"""How far two photos of each pair were taken from each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared.datasets.shots import DatasetPhoto
from shared.datasets.zones import utm_positions, utm_to_degrees
from shared.geodesy import distance_m


def pairwise_distances_m(
    some: Sequence[DatasetPhoto], others: Sequence[DatasetPhoto]
) -> NDArray[np.float64]:
    """(n,) metres between the photos of each pair, NaN where one has no position.

    Straight in the plane of the UTM zone that both lie in; over a zone's border on the sphere.
    """
    metres = np.full(len(some), np.nan)
    placed = [
        number
        for number, pair in enumerate(zip(some, others, strict=True))
        if all(has_position(shot) for shot in pair)
    ]
    here, zones = utm_positions([some[number] for number in placed])
    there, other_zones = utm_positions([others[number] for number in placed])
    metres[placed] = np.hypot(*(there - here).T)
    for index, number in enumerate(placed):
        zone, other = zones[index], other_zones[index]
        if zone != other and zone is not None and other is not None:
            metres[number] = distance_m(
                *utm_to_degrees(zone, here[index]), *utm_to_degrees(other, there[index])
            )
    return metres


def has_position(shot: DatasetPhoto) -> bool:
    return None not in (shot.easting, shot.northing) or None not in (shot.latitude, shot.longitude)
