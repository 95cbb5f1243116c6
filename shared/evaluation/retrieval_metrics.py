"""Every figure of one answered evaluation set.

Which of the ranked database photos are right.

Mean average precision of rankings that end at k.

Precision and recall of the first match, by the score above which it is believed.

How far each ranked photo was taken from its query.

How far from the query its first match was taken.

What the score of the first match says about its being right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.datasets.open_dataset import DatasetPhoto
from shared.datasets.utm_coordinates import pairwise_distances_m
from shared.evaluation.bootstrap import (
    CONFIDENCE_LEVEL,
    RESAMPLES,
    ConfidenceInterval,
    QueryClusters,
    bootstrap_intervals,
)
from shared.evaluation.calibration import (
    FOLDS,
    auroc,
    expected_calibration_error,
    fit_confidence,
    recall_at_precision,
)
from shared.evaluation.exact_knn import Indices, Scores
from shared.evaluation.place_evidence import PlaceEvidence
from shared.evaluation.ranking import DEFAULT_KS, Recalls, compute_recalls

Hits = NDArray[np.bool_]


def compute_hits(ranked: Indices, positives: Sequence[Indices]) -> Hits:
    """(queries, k) database indices, each query's positives -> (queries, k), True where right."""
    rows = [np.isin(row, found) for row, found in zip(ranked, positives, strict=True)]
    return np.array(rows, bool).reshape(ranked.shape)


def hits_at_k(hits: Hits, ks: Sequence[int]) -> NDArray[np.float64]:
    """(queries, k) -> (queries, len(ks)): 1.0 where one of the first k is right, else 0.0."""
    columns = [hits[:, :k].any(axis=1) for k in ks]
    return np.stack(columns, axis=1).astype(np.float64)


def average_precisions(hits: Hits, positive_counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """(queries, k) hits, (queries,) how many positives each has -> (queries,) AP@k.

    AP@k is the sum, over the right ones among the first k, of the precision at their rank, divided
    by min(positives, k): 1 where nothing wrong stands before what could be found (Manning et al.,
    Introduction to Information Retrieval, 8.4, cut at k). NaN for a query without positives: leave
    those out of the mean.
    """
    ranks = np.arange(1, hits.shape[1] + 1)
    precision = np.cumsum(hits, axis=1) / ranks
    sums = (precision * hits).sum(axis=1)
    findable = np.minimum(positive_counts, hits.shape[1]).astype(np.float64)
    unknown = np.full(len(sums), np.nan)
    precisions: NDArray[np.float64] = np.divide(sums, findable, out=unknown, where=findable > 0)
    return precisions


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


Distances = NDArray[np.float64]


def match_distances(
    queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto], ranked: Indices
) -> Distances:
    """(queries, k) database indices -> (queries, k) metres, NaN where one has no position."""
    asked = [query for query, row in zip(queries, ranked, strict=True) for _ in row]
    found = [database[number] for number in ranked.ravel().tolist()]
    return pairwise_distances_m(asked, found).reshape(ranked.shape)


DISTANCE_THRESHOLDS_M = (1, 2, 5, 10, 15, 20, 25, 30, 40, 50, 75, 100, 200, 500, 1000)


def distance_error(metres: NDArray[np.float64]) -> dict[str, Any] | None:
    """(queries,) metres, NaN where not known -> the shares of known ones that lie within x.

    None where none is known.
    """
    known = metres[np.isfinite(metres)]
    if not len(known):
        return None
    return {
        "queries": len(known),
        "without_position": int(len(metres) - len(known)),
        "median_m": float(np.median(known)),
        "within": [
            {"metres": x, "share": float((known <= x).mean())} for x in DISTANCE_THRESHOLDS_M
        ],
    }


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
    """(queries,) cosines of the first match and whether it is right; `queries_with_positive`
    queries have a
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


MAX_CURVE_POINTS = 400  # of a curve that is written down


@dataclass(frozen=True, slots=True)
class RetrievalMetrics:
    """All shares are from 0 to 1."""

    recalls: Recalls
    hits: Hits
    """(queries, depth)"""
    within: NDArray[np.float64]
    """(queries, ks) whether one of the first k is right: what runs are compared by"""
    recall_intervals: list[ConfidenceInterval] | None
    """in the order of the ks"""
    findable_intervals: list[ConfidenceInterval] | None
    mean_average_precision: float
    """at the rankings' depth, over the queries that have a positive"""
    map_interval: ConfidenceInterval | None
    clusters: QueryClusters
    curve: PrecisionRecall | None
    calibration: ScoreCalibration | None
    metres: Distances | None
    """(queries, depth)"""

    @property
    def depth(self) -> int:
        return int(self.hits.shape[1])

    @property
    def recall_curve(self) -> list[float]:
        """Recall at 1, 2, ... to the rankings' depth."""
        first_right = np.logical_or.accumulate(self.hits, axis=1)
        return [float(share) for share in first_right.mean(axis=0)]

    def as_json(self) -> dict[str, Any]:
        ks = list(self.recalls.recall_all)
        return {
            **self.recalls.as_json(),
            "recall_interval": _intervals_by_k(ks, self.recall_intervals),
            "recall_findable_interval": _intervals_by_k(ks, self.findable_intervals),
            "mean_average_precision": {
                "depth": self.depth,
                "mean": _nan_to_none(self.mean_average_precision),
                "interval": self.map_interval.as_json() if self.map_interval else None,
            },
            "intervals": {
                "level": CONFIDENCE_LEVEL,
                "resamples": RESAMPLES,
                "clusters": self.clusters.kind,
                "cluster_count": self.clusters.count,
            },
            "recall_curve": self.recall_curve,
            "precision_recall": _curve_json(self.curve),
            "calibration": asdict(self.calibration) if self.calibration else None,
            "distance_error": None if self.metres is None else distance_error(self.metres[:, 0]),
        }


def compute_metrics(
    ranked: Indices,
    positives: Sequence[Indices],
    clusters: QueryClusters,
    *,
    scores: Scores | None = None,
    metres: Distances | None = None,
    ks: Sequence[int] = DEFAULT_KS,
) -> RetrievalMetrics:
    """(queries, depth) rankings -> their figures; `ks` beyond the depth are left out.

    Without scores (a predictions file has none) there is no precision-recall curve and no
    calibration; without metres no distance error.
    """
    depth = ranked.shape[1]
    ks = [k for k in ks if k <= depth]
    hits = compute_hits(ranked, positives)
    within = hits_at_k(hits, ks)
    counts = np.array([len(found) for found in positives], np.int64)
    findable = counts > 0
    precisions = average_precisions(hits, counts)[findable]
    of_findable = np.column_stack([within[findable], precisions])
    found = bootstrap_intervals(of_findable, clusters.of[findable])
    return RetrievalMetrics(
        recalls=compute_recalls(ranked, positives, ks),
        hits=hits,
        within=within,
        recall_intervals=bootstrap_intervals(within, clusters.of),
        findable_intervals=found[:-1] if found else None,
        mean_average_precision=float(precisions.mean()) if len(precisions) else float("nan"),
        map_interval=found[-1] if found else None,
        clusters=clusters,
        curve=(
            None
            if scores is None
            else precision_recall(scores[:, 0], hits[:, 0], int(findable.sum()))
        ),
        calibration=(
            None
            if scores is None
            else calibrate_scores(scores[:, 0], hits[:, 0], int(findable.sum()), clusters)
        ),
        metres=metres,
    )


def _intervals_by_k(
    ks: Sequence[int], found: list[ConfidenceInterval] | None
) -> dict[str, list[float]] | None:
    if found is None:
        return None
    return {str(k): interval.as_json() for k, interval in zip(ks, found, strict=True)}


def _curve_json(curve: PrecisionRecall | None) -> dict[str, Any] | None:
    if curve is None:
        return None
    count = len(curve.thresholds)
    kept = np.unique(np.linspace(0, count - 1, min(count, MAX_CURVE_POINTS)).round().astype(int))
    return {
        "area": curve.area,
        "points": [
            {
                "score": float(curve.thresholds[place]),
                "precision": float(curve.precision[place]),
                "recall": float(curve.recall[place]),
            }
            for place in kept
        ],
    }


def _nan_to_none(share: float) -> float | None:
    """JSON has no NaN."""
    return None if np.isnan(share) else share
