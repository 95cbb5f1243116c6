"""How good a confidence is: calibration error, AUROC, recall at a precision."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

CALIBRATION_BINS = 10


def expected_calibration_error(confidence: Sequence[float], correct: Sequence[bool]) -> float:
    """Expected calibration error (Naeini et al. 2015) over bins of equally many queries.

    The mean, weighed by size, of |mean confidence - share that is right| over the bins.
    """
    order = np.argsort(confidence, kind="stable")
    said = np.asarray(confidence, dtype=np.float64)[order]
    truth = np.asarray(correct, dtype=np.float64)[order]
    bins = np.array_split(
        np.arange(len(said)), min(CALIBRATION_BINS, max(1, len(said) // CALIBRATION_BINS))
    )
    gaps = [len(b) * abs(float(said[b].mean() - truth[b].mean())) for b in bins]
    return sum(gaps) / len(said)


def auroc(confidence: Sequence[float], correct: Sequence[bool]) -> float | None:
    """P(a right one has a higher confidence than a wrong one), ties half; None without both."""
    said, truth = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=bool)
    wrong = np.sort(said[~truth])
    if truth.all() or not truth.any():
        return None
    below = np.searchsorted(wrong, said[truth], side="left")
    not_above = np.searchsorted(wrong, said[truth], side="right")
    return float((below + not_above).mean() / 2 / len(wrong))


def recall_at_precision(
    confidence: Sequence[float], correct: Sequence[bool], answerable: int, precision: float = 0.99
) -> float:
    """The largest share of `answerable` queries that are answered, and rightly, by accepting all
    above some confidence of which at least `precision` are right. 0 when no such one exists."""
    order = np.argsort(-np.asarray(confidence, dtype=np.float64), kind="stable")
    said = np.asarray(confidence, dtype=np.float64)[order]
    hits = np.cumsum(np.asarray(correct, dtype=np.int64)[order])
    share = hits / np.arange(1, len(said) + 1)
    # Equal confidences are accepted together: only the last of them can be a cut.
    cut = np.append(said[1:] != said[:-1], True) & (share >= precision)
    return float(hits[cut].max() / answerable) if cut.any() and answerable else 0.0
