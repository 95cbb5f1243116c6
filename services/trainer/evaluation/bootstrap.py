"""Confidence intervals by a bootstrap over clusters of queries.

Queries of one street or one drive succeed and fail together: as if they were independent, an
interval would come out too narrow. So whole clusters are drawn, with replacement, as many as there
are, and the mean is taken over the queries in them (cluster bootstrap, Davison and Hinkley 1997,
3.8; percentile intervals). Two runs are compared on the same draws, query by query.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

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
