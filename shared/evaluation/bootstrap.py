"""Confidence intervals by the cluster bootstrap.

Queries of one street or one drive are correlated; treating them as independent would make intervals
too narrow. The bootstrap therefore resamples whole clusters with replacement, as many as there are,
and averages over their queries (cluster bootstrap, Davison and Hinkley 1997, 3.8; percentile
intervals). Where every query has the same outcome, 0 or 1, every resample has it, too, and the
percentiles would claim certainty. A share of 0 or 100 % has Wilson's score interval instead
(Wilson 1927), with the clusters as observations: 0 to z^2 / (n + z^2), or n / (n + z^2) to 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 2000
CONFIDENCE_LEVEL = 0.95
CONFIDENCE_Z = 1.959964  # quantile of the normal distribution at 0.975
MIN_CLUSTERS = 5  # resampling fewer clusters says too little about unseen ones
MAX_COUNTS_PER_BLOCK = 4_000_000  # bounds the memory of the resampled counts

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ConfidenceInterval:
    """Interval at `CONFIDENCE_LEVEL`."""

    low: float
    high: float

    def as_json(self) -> list[float]:
        return [self.low, self.high]

    def as_percent(self) -> str:
        """Return the bounds in per cent: `41.2 to 57.0`."""
        return f"{100 * self.low:.1f} to {100 * self.high:.1f}"


def share_intervals(values: Values, clusters: NDArray[np.int64]) -> list[ConfidenceInterval] | None:
    """Compute intervals as `bootstrap_intervals` does, of shares: values from 0 to 1.

    Those of 0 and 100 % are Wilson's.
    """
    intervals = bootstrap_intervals(values, clusters)
    if intervals is None:
        return None
    count, square = len(np.unique(clusters)), CONFIDENCE_Z**2
    none = ConfidenceInterval(0.0, square / (count + square))
    every = ConfidenceInterval(count / (count + square), 1.0)
    return [
        none if not column.any() else every if (column == 1).all() else interval
        for column, interval in zip(values.T, intervals, strict=True)
    ]


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
