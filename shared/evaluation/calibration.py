"""What a generation's scores mean: a threshold learnt from impostors, a confidence from labels.

*Impostors* are the map's own photos asked without their place: whatever comes first then is wrong.
Their evidence is what a photo from outside the map would show, so a threshold that 95 % of them
stay under accepts about one outsider in twenty. It needs no labels.

A *confidence*, P(the estimate is right), needs queries whose place is known and that were taken on
another day than the photos they match: within one session the right photo always scores high, and
a confidence learnt there would be overconfident ever after. It is a logistic regression on the
evidence (Platt 1999), fitted by Newton's method with a small ridge.

How good a confidence is: calibration error, AUROC, recall at a precision.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from shared.evaluation.place_evidence import PlaceEvidence

FALSE_ACCEPT_RATE = 0.05  # of impostors
MIN_IMPOSTORS = 20  # fewer, and one in twenty can't be told
MIN_LABELLED_QUERIES = 40
MIN_QUERIES_PER_CLASS = 8  # right ones and wrong ones: with fewer the slope is a guess
L2_PENALTY = 0.1  # in units of standardised evidence: keeps separable data finite
NEWTON_STEPS = 50
FOLDS = 5


class LogisticRegression(BaseModel):
    """P = 1 / (1 + exp(-(intercept + sum of weight * (evidence - mean) / scale)))."""

    model_config = ConfigDict(frozen=True)

    intercept: float
    weights: tuple[float, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]

    def probability(self, evidence: PlaceEvidence) -> float:
        """P(right) of one piece of evidence, in (0, 1)."""
        return float(self.probabilities(_matrix([evidence]))[0])

    def probabilities(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) evidence -> (n,) probabilities."""
        standard = (rows - np.array(self.means)) / np.array(self.scales)
        return _sigmoid(self.intercept + standard @ np.array(self.weights))


class Calibration(BaseModel):
    """Stored with the generation that it was learnt on; says nothing about any other."""

    model_config = ConfigDict(frozen=True)

    radius_m: float
    support_threshold: float | None
    """Evidence with less support is "not in this map"; None with too few impostors."""
    impostors: int
    labelled_queries: int
    confidence: LogisticRegression | None
    """None: uncalibrated."""

    @property
    def state(self) -> str:
        """`calibrated` or `uncalibrated`: whether answers carry a confidence."""
        return "uncalibrated" if self.confidence is None else "calibrated"

    def accepts(self, evidence: PlaceEvidence) -> bool | None:
        """Whether the ranking shows a place of the map; None where that can't be told yet."""
        return None if self.support_threshold is None else evidence.support > self.support_threshold


def fit_threshold(impostors: Sequence[PlaceEvidence]) -> float | None:
    """The support that FALSE_ACCEPTS of the impostors exceed; None for fewer than LEAST_IMPOSTORS.

    The smallest order statistic whose rank is high enough: on average at most that share of new
    impostors exceeds it, whatever their distribution (conformal bound, Vovk et al. 2005).
    """
    if len(impostors) < MIN_IMPOSTORS:
        return None
    supports = np.sort([evidence.support for evidence in impostors])
    rank = int(np.ceil((1 - FALSE_ACCEPT_RATE) * (len(supports) + 1)))
    return float(supports[min(rank, len(supports)) - 1])


def fit_confidence(labelled: Sequence[tuple[PlaceEvidence, bool]]) -> LogisticRegression | None:
    """P(right) from (evidence, was it right); None with too few of them, or of one kind."""
    right = sum(ok for _, ok in labelled)
    if (
        len(labelled) < MIN_LABELLED_QUERIES
        or min(right, len(labelled) - right) < MIN_QUERIES_PER_CLASS
    ):
        return None
    rows = _matrix([evidence for evidence, _ in labelled])
    truth = np.array([ok for _, ok in labelled], dtype=np.float64)
    means, scales = rows.mean(axis=0), rows.std(axis=0)
    scales = np.where(scales > 1e-9, scales, 1.0)
    design = np.column_stack([np.ones(len(rows)), (rows - means) / scales])
    ridge = np.diag([0.0, *[L2_PENALTY] * rows.shape[1]])
    beta = np.zeros(design.shape[1])
    for _ in range(NEWTON_STEPS):
        probability = _sigmoid(design @ beta)
        gradient = design.T @ (truth - probability) - ridge @ beta
        spread = np.maximum(probability * (1 - probability), 1e-6)
        step = np.linalg.solve((design.T * spread) @ design + ridge, gradient)
        beta += step
        if float(np.abs(step).max()) < 1e-8:
            break
    return LogisticRegression(
        intercept=float(beta[0]),
        weights=tuple(beta[1:].tolist()),
        means=tuple(means.tolist()),
        scales=tuple(scales.tolist()),
    )


def cross_validate(labelled: Sequence[tuple[PlaceEvidence, bool]]) -> list[float] | None:
    """P(right) of each, learnt from the other folds: what the confidence is worth on new queries.

    None where there are too few to learn from.
    """
    predicted = [0.0] * len(labelled)
    for fold in range(FOLDS):
        learnt = fit_confidence([pair for i, pair in enumerate(labelled) if i % FOLDS != fold])
        if learnt is None:
            return None
        for index in range(fold, len(labelled), FOLDS):
            predicted[index] = learnt.probability(labelled[index][0])
    return predicted


def _matrix(evidence: Sequence[PlaceEvidence]) -> NDArray[np.float64]:
    return np.array([(e.support, e.agreement) for e in evidence], dtype=np.float64)


def _sigmoid(x: NDArray[np.float64]) -> NDArray[np.float64]:
    bounded: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-np.clip(x, -30, 30)))
    return bounded


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
