"""Rides through a generated city: sequences of frames, one per second.

A ride follows the streets of the map with stops. Halfway it leaves the map for a detour through the
outskirts and comes back where it left; after three quarters it jumps to another street, as if the
camera had been carried away. The camera looks to the side that the map shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lab.city.streets import Street, ViewPoint

SPEED_MPS = (6.0, 10.0)
STOP_CHANCE = 0.02
"""per second"""
STOP_SECONDS = (4, 15)
DETOUR_SHARE = 0.15
"""of the frames of a ride"""


@dataclass(frozen=True, slots=True)
class RideFrame:
    """Where the camera is at one second of a ride."""

    is_in_map: bool
    place: ViewPoint
    """the place that is nearest along the street"""
    along: float
    """metres from the place along the street"""


def plan_ride(
    rng: np.random.Generator,
    places: Sequence[ViewPoint],
    outskirts: Sequence[ViewPoint],
    frames: int,
) -> list[RideFrame]:
    """Plan the frames of a ride: drive, detour outside the map, drive on, jump, drive on."""
    detour = round(frames * DETOUR_SHARE)
    first, second = _drive(rng, places), _drive(rng, places)
    outside = _drive(rng, outskirts)
    leaves, jumps = frames // 2 - detour // 2, round(frames * 0.75)
    planned = []
    for second_number in range(frames):
        if leaves <= second_number < leaves + detour:
            planned.append(RideFrame(False, *next(outside)))
        else:
            planned.append(RideFrame(True, *next(first if second_number < jumps else second)))
    return planned


def _drive(
    rng: np.random.Generator, places: Sequence[ViewPoint]
) -> Iterator[tuple[ViewPoint, float]]:
    """Yield the nearest place and the metres from it along its street, second by second."""
    of_street: dict[int, list[ViewPoint]] = {}
    for place in places:
        of_street.setdefault(place.street.number, []).append(place)
    streets = {place.street.number: place.street for place in places}
    street = streets[int(rng.choice(sorted(streets)))]
    forward, travelled, speed, stands = True, 0.0, rng.uniform(*SPEED_MPS), 0
    while True:
        along = travelled if forward else street.length - travelled
        place = min(of_street[street.number], key=lambda each: abs(each.along - along))
        yield place, along - place.along
        if stands:
            stands -= 1
            continue
        if rng.uniform() < STOP_CHANCE:
            stands = int(rng.integers(*STOP_SECONDS))
        speed = float(np.clip(speed + rng.normal(0, 0.5), *SPEED_MPS))
        travelled += speed
        if travelled > street.length:
            travelled -= street.length
            street, forward = _turn(rng, list(streets.values()), street, forward)


def _turn(
    rng: np.random.Generator, streets: Sequence[Street], street: Street, forward: bool
) -> tuple[Street, bool]:
    """Choose a street that goes on from the end of this one, or turn round in a dead end."""
    crossing = _end(street, forward)
    ways = [
        (other, direction)
        for other in streets
        for direction in (True, False)
        if other.number != street.number and math.dist(_end(other, not direction), crossing) < 0.1
    ]
    return ways[int(rng.integers(len(ways)))] if ways else (street, not forward)


def _end(street: Street, forward: bool) -> tuple[float, float]:
    end = street.start + street.direction * (street.length if forward else 0.0)
    return float(end[0]), float(end[1])
