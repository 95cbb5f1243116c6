"""How good stated probabilities are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

CALIBRATION_BINS = 10


def expected_calibration_error(confidence: Sequence[float], correct: Sequence[bool]) -> float:
    """Compute the expected calibration error (Naeini et al. 2015), with equal-mass bins.

    The mean of |mean confidence - accuracy| over the bins, weighted by their size.
    """
    order = np.argsort(confidence, kind="stable")
    predicted = np.asarray(confidence, dtype=np.float64)[order]
    target = np.asarray(correct, dtype=np.float64)[order]
    bins = np.array_split(
        np.arange(len(predicted)), min(CALIBRATION_BINS, max(1, len(predicted) // CALIBRATION_BINS))
    )
    gaps = [len(b) * abs(float(predicted[b].mean() - target[b].mean())) for b in bins]
    return sum(gaps) / len(predicted)
