"""Which queries stand and fall together: those of one sequence, of one place, or of one block."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.bootstrap import LEAST_CLUSTERS
from shared.datasets.sets import Shot
from shared.geodesy import EARTH_RADIUS_M

SQUARE_M = 50.0  # two radii of the usual rule: neighbours share most of their positives


@dataclass(frozen=True, slots=True)
class Clusters:
    of: NDArray[np.int64]
    """(queries,) number of each query's cluster"""
    kind: str
    """`sequences`, `places`, `squares of 50 m` or `queries`"""

    @property
    def count(self) -> int:
        return len(np.unique(self.of))


def clusters_of(queries: Sequence[Shot]) -> Clusters:
    """By sequence where each query has one and they are enough for an interval; else by place;
    else by where it was taken; else each query is alone."""
    for kind, keys in (
        ("sequences", [shot.sequence for shot in queries]),
        ("places", [shot.place for shot in queries]),
        (f"squares of {SQUARE_M:g} m", [_square(shot) for shot in queries]),
    ):
        if None not in keys and len(set(keys)) >= LEAST_CLUSTERS:
            return Clusters(_numbered(keys), kind)
    return alone(len(queries))


def alone(queries: int) -> Clusters:
    """Each query a cluster of its own: of queries of which nothing is known."""
    return Clusters(np.arange(queries), "queries")


def _square(shot: Shot) -> tuple[str | None, int, int] | None:
    if shot.easting is not None and shot.northing is not None:
        return shot.zone, int(shot.easting // SQUARE_M), int(shot.northing // SQUARE_M)
    if shot.latitude is None or shot.longitude is None:
        return None
    metres_a_degree = math.radians(EARTH_RADIUS_M)
    row = int(shot.latitude * metres_a_degree // SQUARE_M)
    shrunk = math.cos(math.radians(row * SQUARE_M / metres_a_degree))  # the same along a row
    return "degrees", row, int(shot.longitude * metres_a_degree * shrunk // SQUARE_M)


def _numbered(keys: Sequence[Hashable]) -> NDArray[np.int64]:
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], np.int64)
