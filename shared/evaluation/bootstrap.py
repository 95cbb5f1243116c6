"""Confidence intervals by the cluster bootstrap, and paired comparison of two runs.

Queries of one street or one drive are correlated; treating them as independent would make intervals
too narrow. The bootstrap therefore resamples whole clusters with replacement, as many as there are,
and averages over their queries (cluster bootstrap, Davison and Hinkley 1997, 3.8; percentile
intervals). Two runs are compared by the differences of their queries, on the same resamples.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 2000
CONFIDENCE_LEVEL = 0.95
MIN_CLUSTERS = 5  # resampling fewer clusters says too little about unseen ones
MAX_COUNTS_PER_BLOCK = 4_000_000  # bounds the memory of the resampled counts

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ConfidenceInterval:
    """Percentile interval at `CONFIDENCE_LEVEL`."""

    low: float
    high: float

    def as_json(self) -> list[float]:
        return [self.low, self.high]

    def as_percent(self) -> str:
        """Return the bounds in per cent: `41.2 to 57.0`."""
        return f"{100 * self.low:.1f} to {100 * self.high:.1f}"


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Difference of a metric's mean between two runs on the same queries: first minus second."""

    mean: float
    low: float | None
    """bounds of the interval; None with too few clusters"""
    high: float | None
    won: int
    """number of queries on which the first run is better"""
    lost: int
    """number of queries on which the second run is better"""

    @property
    def is_significant(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low is not None and self.high is not None and not self.low <= 0 <= self.high

    def interval_in_points(self) -> str | None:
        """Return the interval in percentage points: `-1.2 to +3.4`; None with too few clusters."""
        if self.low is None or self.high is None:
            return None
        return f"{100 * self.low:+.1f} to {100 * self.high:+.1f}"

    def as_json(self) -> dict[str, float | int | bool | None]:
        return {**asdict(self), "beyond_chance": self.is_significant}


def bootstrap_intervals(
    values: Values, clusters: NDArray[np.int64]
) -> list[ConfidenceInterval] | None:
    """Compute the bootstrap interval of each metric's mean.

    Args:
        values: (queries, metrics) float64.
        clusters: (queries,) int64, the cluster label of each query.

    Returns:
        One interval per metric at `CONFIDENCE_LEVEL`; None with fewer than `MIN_CLUSTERS` clusters.
    """
    _, cluster = np.unique(clusters, return_inverse=True)
    count = int(cluster.max()) + 1 if len(cluster) else 0
    if count < MIN_CLUSTERS:
        return None
    sums = np.zeros((count, values.shape[1]))
    np.add.at(sums, cluster, values)
    sizes = np.bincount(cluster, minlength=count).astype(np.float64)
    rng = np.random.default_rng(0)
    means = []
    block = max(1, MAX_COUNTS_PER_BLOCK // count)
    for start in range(0, RESAMPLES, block):
        counts = rng.multinomial(
            count, np.full(count, 1 / count), size=min(block, RESAMPLES - start)
        ).astype(np.float64)
        means.append((counts @ sums) / (counts @ sizes)[:, None])
    tail = (1 - CONFIDENCE_LEVEL) / 2
    low, high = np.quantile(np.concatenate(means), [tail, 1 - tail], axis=0)
    return [ConfidenceInterval(float(a), float(b)) for a, b in zip(low, high, strict=True)]


def paired_differences(
    first: Values, second: Values, clusters: NDArray[np.int64]
) -> list[PairedDifference]:
    """Compute the paired difference of each metric between two runs on the same queries.

    Args:
        first: (queries, metrics) float64.
        second: the same shape, in the same order.
        clusters: (queries,) int64, the cluster label of each query.

    Raises:
        ValueError: the shapes differ.
    """
    if first.shape != second.shape:
        raise ValueError(f"runs of different shape: {first.shape} and {second.shape}")
    difference = first - second
    intervals = bootstrap_intervals(difference, clusters)
    return [
        PairedDifference(
            mean=float(column.mean()),
            low=intervals[index].low if intervals else None,
            high=intervals[index].high if intervals else None,
            won=int((column > 0).sum()),
            lost=int((column < 0).sum()),
        )
        for index, column in enumerate(difference.T)
    ]
