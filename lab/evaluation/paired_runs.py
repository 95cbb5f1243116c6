"""Paired comparison of two runs on the same queries: cluster bootstrap of the differences."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from shared.evaluation.bootstrap import Values, bootstrap_intervals


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


def paired_differences(
    first: Values, second: Values, clusters: NDArray[np.int64]
) -> list[PairedDifference]:
    """Compute the paired difference of each metric between two runs on the same queries.

    `first` and `second` are (queries, metrics) float64, `clusters` the (queries,) cluster labels.
    Raises ValueError if the shapes differ.
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
