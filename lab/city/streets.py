"""Street networks: quarters of blocks, their facade rows, and view points along the streets.

A quarter is a warped grid. Between the streets lie blocks; every side of a block is one vertical
plane, divided into plots with one house each. x is east and y is north, in UTM metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.city.textures import random_stream

SPACING_M = (88.0, 132.0)
"""Between crossings"""
WARP_M = 9.0
"""Maximum offset of a crossing from the grid"""
HALF_WIDTHS_M = (6.5, 7.5, 8.5, 10.0)
"""From a street's centre line to its facades"""
PAVEMENT_M = 2.7
PLOT_M = (6.5, 16.0)

Metres = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Street:
    """The street between two crossings."""

    number: int
    start: Metres
    direction: Metres
    """Unit vector"""
    length: float
    half_width: float
    trees: float
    """Metres between the trees on each side; 0 for none"""
    parking: float
    """Fraction of the kerb with parked vehicles"""

    @property
    def left(self) -> Metres:
        """Unit vector to the left of the direction."""
        return np.array([-self.direction[1], self.direction[0]])


@dataclass(frozen=True, slots=True)
class _FacadeRow:
    """The outer side of a block; seen from the street it runs left to right."""

    start: Metres
    direction: Metres
    length: float
    half_width: float
    """Of the street in front of it"""
    cuts: Metres
    """Boundaries of the plots, from 0 to `length`"""
    shopping: float
    floors: int


class Quarter:
    """One connected street network and the houses along it."""

    def __init__(self, seed: int, name: str, size: int, origin: tuple[float, float]) -> None:
        """`size`: streets per axis; `origin`: south-west corner in UTM metres."""
        self.seed = seed
        self.name = name
        rng = random_stream(seed, name, "streets")
        count = size + 2  # the outermost grid lines bound the outer blocks and have no street
        xs = np.concatenate([[0.0], rng.uniform(*SPACING_M, count - 1).cumsum()])
        ys = np.concatenate([[0.0], rng.uniform(*SPACING_M, count - 1).cumsum()])
        grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
        grid += rng.uniform(-WARP_M, WARP_M, grid.shape)
        self.nodes: Metres = grid + np.asarray(origin)
        self._across = rng.choice(HALF_WIDTHS_M, count)  # streets that run north
        self._along = rng.choice(HALF_WIDTHS_M, count)  # streets that run east
        self.streets = self._lay_streets(rng, count)
        self.sides = self._build_blocks(rng, count)
        self.side_starts = np.stack([side.start for side in self.sides])
        """(sides, 2) start points of the facade rows"""
        self.side_directions = np.stack([side.direction for side in self.sides])
        """(sides, 2) unit vectors"""
        self.side_lengths = np.array([side.length for side in self.sides])
        """(sides,)"""

    @property
    def far_east(self) -> float:
        """The easternmost coordinate, metres."""
        return float(self.nodes[..., 0].max())

    def _lay_streets(self, rng: np.random.Generator, count: int) -> list[Street]:
        ends = []
        for j in range(1, count - 1):
            ends += [((i, j), (i + 1, j), self._along[j]) for i in range(1, count - 2)]
        for i in range(1, count - 1):
            ends += [((i, j), (i, j + 1), self._across[i]) for j in range(1, count - 2)]
        streets = []
        for number, (a, b, half_width) in enumerate(ends):
            first, second = (a, b) if rng.uniform() < 0.5 else (b, a)
            start, end = self.nodes[first], self.nodes[second]
            length = float(np.hypot(*(end - start)))
            streets.append(
                Street(
                    number=number,
                    start=start,
                    direction=(end - start) / length,
                    length=length,
                    half_width=float(half_width),
                    trees=float(rng.choice([0.0, 0.0, 9.0, 12.0, 15.0])),
                    parking=float(rng.uniform(0.1, 0.5)),
                )
            )
        return streets

    def _build_blocks(self, rng: np.random.Generator, count: int) -> list[_FacadeRow]:
        sides = []
        for i in range(count - 1):
            for j in range(count - 1):
                corners = [self.nodes[i + x, j + y] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
                insets = [self._along[j], self._across[i + 1], self._along[j + 1], self._across[i]]
                outline = _inset(corners, insets)
                for k in range(4):
                    start, end = outline[k], outline[(k + 1) % 4]
                    length = float(np.hypot(*(end - start)))
                    sides.append(
                        _FacadeRow(
                            start=start,
                            direction=(end - start) / length,
                            length=length,
                            half_width=float(insets[k]),
                            cuts=_cut_plots(rng, length),
                            shopping=float(rng.choice([0.0, 0.25, 0.6])),
                            floors=int(rng.integers(2, 5)),
                        )
                    )
        return sides


def _inset(corners: list[Metres], insets: list[float]) -> list[Metres]:
    """Return a counter-clockwise quadrilateral with side k moved inwards by insets[k] metres."""
    lines = []
    for k in range(4):
        direction = corners[(k + 1) % 4] - corners[k]
        direction = direction / np.hypot(*direction)
        inwards = np.array([-direction[1], direction[0]])
        lines.append((corners[k] + inwards * insets[k], direction))
    outline = []
    for k in range(4):
        (p, d), (q, e) = lines[k - 1], lines[k]
        along = ((q - p)[0] * e[1] - (q - p)[1] * e[0]) / (d[0] * e[1] - d[1] * e[0])
        outline.append(p + along * d)
    return outline


def _cut_plots(rng: np.random.Generator, length: float) -> Metres:
    """Return the boundaries of plots of PLOT_M, scaled to fill the length."""
    widths: list[float] = []
    while sum(widths) < length:
        widths.append(rng.uniform(*PLOT_M))
    cuts = np.concatenate([[0.0], np.cumsum(widths)])
    scaled: Metres = cuts * (length / cuts[-1])
    return scaled


PLACE_SPACING_M = (15.0, 25.0)
FROM_CROSSING_M = 14.0
LOOK_M = (42.0, 64.0)
"""Degrees between the driving direction and a street's viewing direction"""


@dataclass(frozen=True, slots=True)
class ViewPoint:
    """A position in a street and the viewing direction there: one place."""

    number: int
    street: Street
    along: float
    """Metres from the street's start"""
    yaw: float
    """degrees clockwise from north"""


def make_quarter(
    seed: int, name: str, place_count: int, origin: tuple[float, float]
) -> tuple[Quarter, list[ViewPoint]]:
    """Create the smallest quarter with `place_count` places; return both."""
    size = 2
    while True:
        quarter = Quarter(seed, name, size, origin)
        places = _find_places(quarter)
        if len(places) >= place_count:
            return quarter, places[:place_count]
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
