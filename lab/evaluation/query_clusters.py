"""Clusters of queries for the bootstrap: by sequence, by place, or by square of 50 m."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.datasets.dataset import DatasetPhoto
from shared.evaluation.bootstrap import MIN_CLUSTERS
from shared.geodesy import EARTH_RADIUS_M

GRID_CELL_M = 50.0  # twice the usual positive radius: queries in a cell share most positives


@dataclass(frozen=True, slots=True)
class QueryClusters:
    """Assignment of queries to bootstrap clusters."""

    labels: NDArray[np.int64]
    """(queries,) cluster label of each query"""
    kind: str
    """`sequences`, `places`, `squares of 50 m` or `queries`"""

    @property
    def count(self) -> int:
        return len(np.unique(self.labels))


def cluster_queries(queries: Sequence[DatasetPhoto]) -> QueryClusters:
    """Cluster queries by sequence, by place or by position.

    Uses the first of these that is known for every query and gives `MIN_CLUSTERS` clusters or
    more. If there is none, each query is a cluster.
    """
    for kind, keys in (
        ("sequences", [photo.sequence for photo in queries]),
        ("places", [photo.place for photo in queries]),
        (f"squares of {GRID_CELL_M:g} m", [_grid_cell(photo) for photo in queries]),
    ):
        if None not in keys and len(set(keys)) >= MIN_CLUSTERS:
            numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
            return QueryClusters(np.array([numbers[key] for key in keys], np.int64), kind)
    return singleton_clusters(len(queries))


def singleton_clusters(queries: int) -> QueryClusters:
    """Make each query a cluster of its own, for queries without metadata."""
    return QueryClusters(np.arange(queries), "queries")


def _grid_cell(photo: DatasetPhoto) -> tuple[str | None, int, int] | None:
    if photo.easting is not None and photo.northing is not None:
        return photo.zone, int(photo.easting // GRID_CELL_M), int(photo.northing // GRID_CELL_M)
    if photo.latitude is None or photo.longitude is None:
        return None
    metres_per_degree = math.radians(EARTH_RADIUS_M)
    row = int(photo.latitude * metres_per_degree // GRID_CELL_M)
    # One factor for the whole row, so that its cells line up.
    scale = math.cos(math.radians(row * GRID_CELL_M / metres_per_degree))
    return "degrees", row, int(photo.longitude * metres_per_degree * scale // GRID_CELL_M)
