"""Places: the spots along a quarter's streets that photos are taken of."""

from __future__ import annotations

import math
from dataclasses import dataclass

from shared.datasets.city.random_streams import random_stream
from shared.datasets.city.streets import Quarter, Street

PLACE_SPACING_M = (15.0, 25.0)
FROM_CROSSING_M = 14.0
LOOK_M = (42.0, 64.0)
"""degrees between the driving direction and a street's viewing direction"""


@dataclass(frozen=True, slots=True)
class ViewPoint:
    """A spot in a street that the camera passes, and where it looks from there."""

    number: int
    street: Street
    along: float
    """metres from the street's start"""
    yaw: float
    """degrees clockwise from north"""


def make_quarter(
    seed: int, name: str, wanted: int, origin: tuple[float, float]
) -> tuple[Quarter, list[ViewPoint]]:
    """The smallest quarter with that many places, and its first ones."""
    size = 2
    while True:
        quarter = Quarter(seed, name, size, origin)
        places = _find_places(quarter)
        if len(places) >= wanted:
            return quarter, places[:wanted]
        size += 1


def _find_places(quarter: Quarter) -> list[ViewPoint]:
    rng = random_stream(quarter.seed, quarter.name, "places")
    places: list[ViewPoint] = []
    for street in quarter.streets:
        heading = math.degrees(math.atan2(street.direction[0], street.direction[1]))
        yaw = heading - rng.uniform(*LOOK_M)
        along = FROM_CROSSING_M + rng.uniform(0, 5)
        while along < street.length - FROM_CROSSING_M:
            places.append(ViewPoint(len(places), street, along, yaw + rng.normal(0, 3)))
            along += rng.uniform(*PLACE_SPACING_M)
    return places
