"""Confidence intervals by a bootstrap over clusters of queries.

Queries of one street or one drive succeed and fail together: as if they were independent, an
interval would come out too narrow. So whole clusters are drawn, with replacement, as many as there
are, and the mean is taken over the queries in them (cluster bootstrap, Davison and Hinkley 1997,
3.8; percentile intervals). Two runs are compared on the same draws, query by query.

Which queries stand and fall together: those of one sequence, of one place, or of one block.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from shared.datasets.open_dataset import DatasetPhoto
from shared.geodesy import EARTH_RADIUS_M

RESAMPLES = 2000
CONFIDENCE_LEVEL = 0.95
MIN_CLUSTERS = 5  # of fewer, the draws say nothing about clusters that were never seen
MAX_DRAWN_COUNTS = 4_000_000  # counts

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ConfidenceInterval:
    low: float
    high: float

    def as_json(self) -> list[float]:
        return [self.low, self.high]


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Of the means of two runs on the same queries: the first less the second."""

    mean: float
    low: float | None
    high: float | None
    won: int
    """queries on which the first run is better"""
    lost: int

    @property
    def is_significant(self) -> bool:
        """Whether 0 lies outside of the interval."""
        return self.low is not None and self.high is not None and not self.low <= 0 <= self.high

    def as_json(self) -> dict[str, float | int | bool | None]:
        return {**asdict(self), "beyond_chance": self.is_significant}


def bootstrap_intervals(
    values: Values, clusters: NDArray[np.int64], *, resamples: int = RESAMPLES, seed: int = 0
) -> list[ConfidenceInterval] | None:
    """(queries, figures), (queries,) numbers of clusters -> LEVEL interval of each figure's mean.

    None with fewer than LEAST_CLUSTERS clusters.
    """
    _, cluster = np.unique(clusters, return_inverse=True)
    count = int(cluster.max()) + 1 if len(cluster) else 0
    if count < MIN_CLUSTERS:
        return None
    sums = np.zeros((count, values.shape[1]))
    np.add.at(sums, cluster, values)
    sizes = np.bincount(cluster, minlength=count).astype(np.float64)
    random = np.random.default_rng(seed)
    means = []
    at_once = max(1, MAX_DRAWN_COUNTS // count)
    for begin in range(0, resamples, at_once):
        drawn = random.multinomial(
            count, np.full(count, 1 / count), size=min(at_once, resamples - begin)
        ).astype(np.float64)
        means.append((drawn @ sums) / (drawn @ sizes)[:, None])
    tail = (1 - CONFIDENCE_LEVEL) / 2
    low, high = np.quantile(np.concatenate(means), [tail, 1 - tail], axis=0)
    return [ConfidenceInterval(float(a), float(b)) for a, b in zip(low, high, strict=True)]


def paired_differences(
    first: Values, second: Values, clusters: NDArray[np.int64], *, seed: int = 0
) -> list[PairedDifference]:
    """(queries, figures) of two runs -> the difference of each figure's mean, with its interval."""
    if first.shape != second.shape:
        raise ValueError(f"runs of different shape: {first.shape} and {second.shape}")
    difference = first - second
    found = bootstrap_intervals(difference, clusters, seed=seed)
    return [
        PairedDifference(
            mean=float(column.mean()),
            low=found[place].low if found else None,
            high=found[place].high if found else None,
            won=int((column > 0).sum()),
            lost=int((column < 0).sum()),
        )
        for place, column in enumerate(difference.T)
    ]


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
