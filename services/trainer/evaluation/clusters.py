"""Which queries stand and fall together: those of one sequence, of one place, or of one block."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.bootstrap import MIN_CLUSTERS
from shared.datasets.sets import DatasetPhoto
from shared.geodesy import EARTH_RADIUS_M

GRID_CELL_M = 50.0  # two radii of the usual rule: neighbours share most of their positives


@dataclass(frozen=True, slots=True)
class QueryClusters:
    of: NDArray[np.int64]
    """(queries,) number of each query's cluster"""
    kind: str
    """`sequences`, `places`, `squares of 50 m` or `queries`"""

    @property
    def count(self) -> int:
        return len(np.unique(self.of))


def cluster_queries(queries: Sequence[DatasetPhoto]) -> QueryClusters:
    """By sequence where each query has one and they are enough for an interval; else by place;
    else by where it was taken; else each query is alone."""
    for kind, keys in (
        ("sequences", [shot.sequence for shot in queries]),
        ("places", [shot.place for shot in queries]),
        (f"squares of {GRID_CELL_M:g} m", [_grid_cell_of(shot) for shot in queries]),
    ):
        if None not in keys and len(set(keys)) >= MIN_CLUSTERS:
            return QueryClusters(_number_labels(keys), kind)
    return singleton_clusters(len(queries))


def singleton_clusters(queries: int) -> QueryClusters:
    """Each query a cluster of its own: of queries of which nothing is known."""
    return QueryClusters(np.arange(queries), "queries")


def _grid_cell_of(shot: DatasetPhoto) -> tuple[str | None, int, int] | None:
    if shot.easting is not None and shot.northing is not None:
        return shot.zone, int(shot.easting // GRID_CELL_M), int(shot.northing // GRID_CELL_M)
    if shot.latitude is None or shot.longitude is None:
        return None
    metres_a_degree = math.radians(EARTH_RADIUS_M)
    row = int(shot.latitude * metres_a_degree // GRID_CELL_M)
    shrunk = math.cos(math.radians(row * GRID_CELL_M / metres_a_degree))  # the same along a row
    return "degrees", row, int(shot.longitude * metres_a_degree * shrunk // GRID_CELL_M)


def _number_labels(keys: Sequence[Hashable]) -> NDArray[np.int64]:
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], np.int64)
