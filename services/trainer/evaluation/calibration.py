"""What the score of the first match says about its being right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.clusters import QueryClusters
from shared.estimate.calibration import FOLDS, fit_confidence
from shared.estimate.evidence import PlaceEvidence
from shared.estimate.figures import auroc, expected_calibration_error, recall_at_precision

TARGET_PRECISION = 0.99


@dataclass(frozen=True, slots=True)
class ScoreCalibration:
    auroc: float | None
    """P(a right first match scores higher than a wrong one); None where all are of one kind."""
    recall_at_99_precision: float
    """Of the queries that have a positive, the share answered rightly above a score at which 99 %
    of the answers are right."""
    calibration_error: float | None
    """Of a logistic regression on the score, learnt from other clusters than it is tested on. None
    where there are too few queries, right ones or wrong ones to learn from."""


def calibrate_scores(
    scores: NDArray[np.floating],
    correct: NDArray[np.bool_],
    queries_with_positive: int,
    clusters: QueryClusters,
) -> ScoreCalibration:
    """(queries,) cosines of the first match and whether it is right; `queries_with_positive` queries have a
    positive."""
    said, truth = scores.astype(np.float64).tolist(), correct.tolist()
    confidence = _cross_validated_confidence(said, truth, clusters)
    return ScoreCalibration(
        auroc=auroc(said, truth),
        recall_at_99_precision=recall_at_precision(
            said, truth, queries_with_positive, TARGET_PRECISION
        ),
        calibration_error=None
        if confidence is None
        else expected_calibration_error(confidence, truth),
    )


def _cross_validated_confidence(
    scores: list[float], correct: list[bool], clusters: QueryClusters
) -> list[float] | None:
    """P(right) of each query, learnt from the queries of other folds; a cluster is of one fold."""
    fold = np.random.default_rng(0).permutation(int(clusters.of.max(initial=-1)) + 1) % FOLDS
    folds = fold[clusters.of] if len(scores) else np.empty(0, np.int64)
    evidence = [PlaceEvidence(score, 0.0) for score in scores]  # the score alone
    predicted = [0.0] * len(scores)
    for held_out in range(FOLDS):
        learnt = fit_confidence(
            [(e, r) for e, r, f in zip(evidence, correct, folds, strict=True) if f != held_out]
        )
        if learnt is None:
            return None
        for place in np.flatnonzero(folds == held_out):
            predicted[place] = learnt.probability(evidence[place])
    return predicted
