"""How well confidences tell right from wrong queries: AUROC, and recall at a precision."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def auroc(confidence: Sequence[float], correct: Sequence[bool]) -> float | None:
    """Compute the AUROC: P(a correct query has a higher confidence than a wrong one).

    Ties count half. None unless there are both correct and wrong queries.
    """
    predicted, target = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=bool)
    wrong = np.sort(predicted[~target])
    if target.all() or not target.any():
        return None
    below = np.searchsorted(wrong, predicted[target], side="left")
    not_above = np.searchsorted(wrong, predicted[target], side="right")
    return float((below + not_above).mean() / 2 / len(wrong))


def recall_at_precision(
    confidence: Sequence[float], correct: Sequence[bool], answerable: int, precision: float = 0.99
) -> float:
    """Compute the highest recall of any confidence threshold that has the required precision.

    `answerable` queries can be answered correctly: the denominator of the recall, which is 0 if no
    threshold has the precision.
    """
    order = np.argsort(-np.asarray(confidence, dtype=np.float64), kind="stable")
    predicted = np.asarray(confidence, dtype=np.float64)[order]
    hits = np.cumsum(np.asarray(correct, dtype=np.int64)[order])
    precisions = hits / np.arange(1, len(predicted) + 1)
    # Equal confidences are accepted together, so a threshold follows the last of them.
    is_cut = np.append(predicted[1:] != predicted[:-1], True) & (precisions >= precision)
    return float(hits[is_cut].max() / answerable) if is_cut.any() and answerable else 0.0
