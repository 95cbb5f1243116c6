"""Precision and recall of the first match, by the score above which it is believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Curve = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PrecisionRecall:
    """A point for each distinct score, the highest first."""

    thresholds: Curve
    precision: Curve
    """Of the answers with at least that score, the share that is right."""
    recall: Curve
    """Of the queries that have a positive, the share that is answered so, and rightly."""
    area: float
    """Under the curve in steps: the sum of (R_i - R_(i-1)) P_i."""


def precision_recall(
    scores: NDArray[np.floating], correct: NDArray[np.bool_], queries_with_positive: int
) -> PrecisionRecall | None:
    """(queries,) scores of the first match and whether it is right; None without a findable query.

    Queries without a positive are asked, too: what is answered there counts against precision.
    """
    if not queries_with_positive or not len(scores):
        return None
    order = np.argsort(-scores, kind="stable")
    said, hits = scores[order], np.cumsum(correct[order])
    # Equal scores are believed together.
    cut = np.flatnonzero(np.append(said[1:] != said[:-1], True))
    precision, recall = hits[cut] / (cut + 1), hits[cut] / queries_with_positive
    steps = np.diff(recall, prepend=0.0)
    return PrecisionRecall(
        said[cut].astype(np.float64), precision, recall, float((steps * precision).sum())
    )
