"""Calibration of a generation's scores: open-set threshold, place model, and metrics.

The *threshold* decides whether a query shows a place of the map. It is fitted on *impostors*: the
map's own photos, searched with all photos of their place excluded, so that every match is wrong.
Their evidence is that of photos from outside the map, so a threshold that 95 % of them do not
exceed accepts about one outside photo in twenty. It needs no labelled queries.

`fit_confidence` fits P(the first match is correct) to queries whose place is known, for evaluations
of data sets: a logistic regression (Platt 1999) by Newton's method with a small L2 penalty.

Metrics of a confidence: expected calibration error (ECE), AUROC, recall at a given precision.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from shared.evaluation.places.evidence import PlaceEvidence
from shared.evaluation.places.probability import PlaceModel

FALSE_ACCEPT_RATE = 0.05  # of impostors
MIN_IMPOSTORS = 20  # with fewer, a rate of one in twenty cannot be estimated
MIN_LABELLED_QUERIES = 40
MIN_QUERIES_PER_CLASS = 8  # correct and wrong queries each; with fewer the slope is unreliable
L2_PENALTY = 0.1  # on standardised evidence; keeps weights finite on separable data
NEWTON_STEPS = 50


class LogisticRegression(BaseModel):
    """Logistic regression on standardised evidence.

    P = 1 / (1 + exp(-(intercept + sum of weight * (evidence - mean) / scale))).
    """

    model_config = ConfigDict(frozen=True)

    intercept: float
    weights: tuple[float, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]

    def probability(self, evidence: PlaceEvidence) -> float:
        """Return P(correct) for one query's evidence, in (0, 1)."""
        return float(self.probabilities(_matrix([evidence]))[0])

    def probabilities(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return P(correct) for (n, 2) rows of support and agreement, (n,) float64."""
        standardised = (rows - np.array(self.means)) / np.array(self.scales)
        return _sigmoid(self.intercept + standardised @ np.array(self.weights))


class Calibration(BaseModel):
    """Calibration of one generation's scores, stored with it. It is not valid for another one."""

    model_config = ConfigDict(frozen=True)

    radius_m: float
    support_threshold: float | None
    """Queries whose support does not exceed it are "not in this map"; None: too few impostors."""
    impostors: int
    """number of impostors that the threshold was fitted on"""
    places: PlaceModel | None = None
    """probabilities of the levels of estimates; None in calibrations of earlier releases"""

    def accepts(self, evidence: PlaceEvidence) -> bool | None:
        """Return whether the query shows a place of the map; None without a threshold."""
        return None if self.support_threshold is None else evidence.support > self.support_threshold


def fit_threshold(impostors: Sequence[PlaceEvidence]) -> float | None:
    """Fit the support threshold that at most `FALSE_ACCEPT_RATE` of new impostors exceed.

    It is the smallest order statistic of sufficient rank. The bound holds on average for any
    distribution of the impostors (conformal prediction, Vovk et al. 2005).

    Returns:
        The threshold; None for fewer than `MIN_IMPOSTORS`.
    """
    if len(impostors) < MIN_IMPOSTORS:
        return None
    supports = np.sort([evidence.support for evidence in impostors])
    rank = int(np.ceil((1 - FALSE_ACCEPT_RATE) * (len(supports) + 1)))
    return float(supports[min(rank, len(supports)) - 1])


def fit_confidence(labelled: Sequence[tuple[PlaceEvidence, bool]]) -> LogisticRegression | None:
    """Fit P(correct) on pairs of evidence and whether the estimate was correct.

    Returns:
        The regression; None with fewer than `MIN_LABELLED_QUERIES` queries, or fewer than
        `MIN_QUERIES_PER_CLASS` correct or wrong ones.
    """
    correct = sum(is_correct for _, is_correct in labelled)
    if (
        len(labelled) < MIN_LABELLED_QUERIES
        or min(correct, len(labelled) - correct) < MIN_QUERIES_PER_CLASS
    ):
        return None
    rows = _matrix([evidence for evidence, _ in labelled])
    target = np.array([is_correct for _, is_correct in labelled], dtype=np.float64)
    means, scales = rows.mean(axis=0), rows.std(axis=0)
    scales = np.where(scales > 1e-9, scales, 1.0)
    design = np.column_stack([np.ones(len(rows)), (rows - means) / scales])
    penalty = np.diag([0.0, *[L2_PENALTY] * rows.shape[1]])
    beta = np.zeros(design.shape[1])
    for _ in range(NEWTON_STEPS):
        probability = _sigmoid(design @ beta)
        gradient = design.T @ (target - probability) - penalty @ beta
        variance = np.maximum(probability * (1 - probability), 1e-6)
        step = np.linalg.solve((design.T * variance) @ design + penalty, gradient)
        beta += step
        if float(np.abs(step).max()) < 1e-8:
            break
    return LogisticRegression(
        intercept=float(beta[0]),
        weights=tuple(beta[1:].tolist()),
        means=tuple(means.tolist()),
        scales=tuple(scales.tolist()),
    )


def _matrix(evidence: Sequence[PlaceEvidence]) -> NDArray[np.float64]:
    return np.array([(e.support, e.agreement) for e in evidence], dtype=np.float64)


def _sigmoid(x: NDArray[np.float64]) -> NDArray[np.float64]:
    probabilities: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-np.clip(x, -30, 30)))
    return probabilities


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

    Args:
        confidence: confidence of each query.
        correct: whether each query's estimate is correct.
        answerable: number of queries that can be answered correctly, the denominator of recall.
        precision: minimum share of correct answers among those above the threshold.

    Returns:
        The recall, from 0 to 1; 0 if no threshold has the precision.
    """
    order = np.argsort(-np.asarray(confidence, dtype=np.float64), kind="stable")
    predicted = np.asarray(confidence, dtype=np.float64)[order]
    hits = np.cumsum(np.asarray(correct, dtype=np.int64)[order])
    precisions = hits / np.arange(1, len(predicted) + 1)
    # Equal confidences are accepted together, so a threshold follows the last of them.
    is_cut = np.append(predicted[1:] != predicted[:-1], True) & (precisions >= precision)
    return float(hits[is_cut].max() / answerable) if is_cut.any() and answerable else 0.0
