"""One house: the arrangement of the catalogue's parts that makes it this house."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.datasets.city.catalogue import (
    ACCENTS,
    DOORS,
    ROOFS,
    SHOPS,
    TRIMS,
    WALLS,
    WINDOW_TYPES,
)
from shared.datasets.city.openings import metres_to_pixels
from shared.datasets.city.walls import PIXELS_PER_METRE

HEADROOM = 3.6
"""metres above the eaves for roof, gable and chimneys; also the see-through rim of the texture"""


@dataclass(frozen=True, slots=True)
class House:
    """The arrangement of one house, metres; indices are those of the catalogue."""

    width: float
    floors: int
    ground_floor: float
    """height of the ground floor"""
    storey: float
    """height of every floor above it"""
    wall: int
    base_wall: int
    window: int
    upper_window: int
    bays: int
    blank_bays: tuple[int, ...]
    """bays without windows"""
    door_bay: int
    door: int
    shops: tuple[int, ...]
    """sign of each bay's shop, -1 for none"""
    awning: int
    trim: int
    roof: str
    roof_colour: int
    chimneys: tuple[float, ...]
    string_courses: bool
    quoins: bool
    drainpipe: float
    detail_seed: int

    @property
    def eaves(self) -> float:
        """Height of the wall's top."""
        return self.ground_floor + (self.floors - 1) * self.storey

    @property
    def top(self) -> float:
        """Height of the texture's upper edge."""
        return self.eaves + HEADROOM

    @property
    def pixels(self) -> int:
        """Of its texture."""
        return metres_to_pixels(self.width) * metres_to_pixels(self.top)


def arrange_house(rng: np.random.Generator, width: float, shopping: float, floors: int) -> House:
    """A house for a plot `width` metres wide; `shopping` is the share of bays with a shop."""
    bays = max(1, round(width / rng.uniform(2.3, 3.3)))
    trade = rng.uniform() < shopping
    shops = tuple(
        int(rng.integers(SHOPS)) if trade and rng.uniform() < 0.8 else -1 for _ in range(bays)
    )
    window = int(rng.integers(WINDOW_TYPES))
    blank = tuple(int(b) for b in range(bays) if bays > 2 and rng.uniform() < 0.10)
    return House(
        width=width,
        floors=int(np.clip(floors + rng.integers(-1, 2), 2, 5)),
        ground_floor=float(rng.choice([3.3, 3.7, 4.2])),
        storey=float(rng.choice([2.9, 3.1, 3.4])),
        wall=int(rng.integers(WALLS)),
        base_wall=int(rng.integers(WALLS)) if rng.uniform() < 0.45 else -1,
        window=window,
        upper_window=window if rng.uniform() < 0.6 else int(rng.integers(WINDOW_TYPES)),
        bays=bays,
        blank_bays=blank,
        door_bay=int(rng.integers(bays)),
        door=int(rng.integers(DOORS)),
        shops=shops,
        awning=int(rng.integers(ACCENTS)) if rng.uniform() < 0.6 else -1,
        trim=int(rng.integers(TRIMS)),
        roof=str(rng.choice(["cornice", "cornice", "mansard", "gable", "parapet"])),
        roof_colour=int(rng.integers(ROOFS)),
        chimneys=tuple(float(x) for x in rng.uniform(0.05, 0.9, int(rng.integers(0, 4)))),
        string_courses=bool(rng.uniform() < 0.5),
        quoins=bool(rng.uniform() < 0.3),
        drainpipe=float(rng.choice([-1.0, 0.02, 0.98])),
        detail_seed=int(rng.integers(2**31)),
    )


def bay_centre_column(house: House, bay: int) -> int:
    """The column of the facade's texture that is the middle of a bay."""
    return round((bay + 0.5) * house.width / house.bays * PIXELS_PER_METRE)
