"""Retrieval metrics of one evaluation set: recall@k, mAP@k, precision-recall, distance error.

Also measures how well the score of the first match tells whether it is correct: AUROC, and recall
at 99 % precision. Means have cluster-bootstrap intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import mannwhitneyu

from lab.datasets.dataset import DatasetPhoto
from lab.datasets.utm_coordinates import pairwise_distances_m
from lab.evaluation.exact_knn import Indices, Scores
from lab.evaluation.query_clusters import QueryClusters
from lab.evaluation.ranking import DEFAULT_KS, Recalls, compute_recalls
from lab.evaluation.recall import Hits, compute_hits
from shared.evaluation.bootstrap import (
    CONFIDENCE_LEVEL,
    RESAMPLES,
    ConfidenceInterval,
    share_intervals,
)


def hits_at_k(hits: Hits, ks: Sequence[int]) -> NDArray[np.float64]:
    """Return (queries, len(ks)) float64: 1.0 if one of the first k is a positive, else 0.0."""
    columns = [hits[:, :k].any(axis=1) for k in ks]
    return np.stack(columns, axis=1).astype(np.float64)


def average_precisions(hits: Hits, positive_counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Compute the average precision at k of each query, (queries,) float64, of (queries, k) hits.

    AP@k is the sum of the precisions at the ranks of the positives among the first k, divided by
    min(positives, k). It is 1 if no wrong photo is ranked above a positive (Manning et al.,
    Introduction to Information Retrieval, 8.4, truncated at k). NaN for a query without positives,
    to be excluded from the mean.
    """
    ranks = np.arange(1, hits.shape[1] + 1)
    precision = np.cumsum(hits, axis=1) / ranks
    sums = (precision * hits).sum(axis=1)
    findable = np.minimum(positive_counts, hits.shape[1]).astype(np.float64)
    result = np.full(len(sums), np.nan)
    precisions: NDArray[np.float64] = np.divide(sums, findable, out=result, where=findable > 0)
    return precisions


Curve = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PrecisionRecall:
    """Precision-recall curve of the first match, with a point per distinct score, highest first."""

    thresholds: Curve
    """minimum score at which a first match is accepted"""
    precision: Curve
    """share of the accepted first matches that are correct"""
    recall: Curve
    """share of the queries with a positive whose first match is accepted and correct"""
    area: float
    """average precision: the sum of (R_i - R_(i-1)) P_i"""

    def recall_at(self, precision: float) -> float:
        """Return the highest recall of a threshold with this precision; 0 if none has it."""
        return float(self.recall[self.precision >= precision].max(initial=0.0))


def precision_recall(
    scores: NDArray[np.floating], correct: NDArray[np.bool_], queries_with_positive: int
) -> PrecisionRecall | None:
    """Compute the precision-recall curve of the (queries,) first matches over score thresholds.

    Queries without a positive are included: accepting their first match lowers precision. None
    without a query that has a positive.
    """
    if not queries_with_positive or not len(scores):
        return None
    order = np.argsort(-scores, kind="stable")
    ordered, hits = scores[order], np.cumsum(correct[order])
    # Equal scores are accepted together, so a threshold follows the last of them.
    cuts = np.flatnonzero(np.append(ordered[1:] != ordered[:-1], True))
    precision, recall = hits[cuts] / (cuts + 1), hits[cuts] / queries_with_positive
    steps = np.diff(recall, prepend=0.0)
    return PrecisionRecall(
        ordered[cuts].astype(np.float64), precision, recall, float((steps * precision).sum())
    )


def auroc(scores: NDArray[np.floating], correct: NDArray[np.bool_]) -> float | None:
    """Compute the AUROC: P(a correct query scores higher than a wrong one); ties count half.

    None unless there are both correct and wrong queries.
    """
    if correct.all() or not correct.any():
        return None
    won = mannwhitneyu(scores[correct], scores[~correct]).statistic
    return float(won / correct.sum() / (~correct).sum())


Distances = NDArray[np.float64]


def match_distances(
    queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto], ranked: Indices
) -> Distances:
    """Compute the distance of each of the (queries, k) ranked photos from its query, in metres.

    NaN where a photo has no position.
    """
    repeated = [query for query, row in zip(queries, ranked, strict=True) for _ in row]
    matches = [database[index] for index in ranked.ravel().tolist()]
    return pairwise_distances_m(repeated, matches).reshape(ranked.shape)


DISTANCE_THRESHOLDS_M = (1, 2, 5, 10, 15, 20, 25, 30, 40, 50, 75, 100, 200, 500, 1000)


def distance_error(metres: NDArray[np.float64]) -> dict[str, Any] | None:
    """Summarise the (queries,) metres of first matches, NaN if unknown; None if all are.

    Returns `queries`, `without_position`, `median_m`, and the shares `within` given distances.
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


MAX_CURVE_POINTS = 400  # points of a curve in metrics.json


@dataclass(frozen=True, slots=True)
class RetrievalMetrics:
    """Metrics of one evaluation set. Shares are from 0 to 1."""

    recalls: Recalls
    hits: Hits
    """(queries, depth) whether each ranked photo is a positive"""
    within: NDArray[np.float64]
    """(queries, ks) whether one of the first k is a positive; runs are compared by it"""
    recall_intervals: list[ConfidenceInterval] | None
    """intervals of `recalls.recall_all`, in the order of the ks; None with too few clusters"""
    findable_intervals: list[ConfidenceInterval] | None
    """intervals of `recalls.recall_findable`"""
    mean_average_precision: float
    """mAP at the rankings' depth, over the queries that have a positive"""
    map_interval: ConfidenceInterval | None
    clusters: QueryClusters
    curve: PrecisionRecall | None
    """None without scores"""
    auroc: float | None
    """P(a correct first match scores higher than a wrong one); None without scores or both kinds"""
    recall_at_99_precision: float | None
    """recall at the score threshold above which 99 % of first matches are correct"""
    metres: Distances | None
    """(queries, depth) distance of each ranked photo from its query; None if unknown"""

    @property
    def depth(self) -> int:
        return int(self.hits.shape[1])

    @property
    def recall_curve(self) -> list[float]:
        """Recall@1, recall@2, ... up to the rankings' depth."""
        hit_so_far = np.logical_or.accumulate(self.hits, axis=1)
        return [float(recall) for recall in hit_so_far.mean(axis=0)]

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
            "auroc": self.auroc,
            "recall_at_99_precision": self.recall_at_99_precision,
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
    """Compute all metrics of an evaluation set.

    Args:
        ranked: (queries, depth) database indices, best first.
        positives: database indices of each query's positives.
        clusters: clusters of correlated queries, for the intervals.
        scores: (queries, depth) cosines; None omits the figures of the first match's score.
        metres: (queries, depth) distances from the query; None omits the distance error.
        ks: the values of k; those beyond the depth are ignored.
    """
    depth = ranked.shape[1]
    ks = [k for k in ks if k <= depth]
    hits = compute_hits(ranked, positives)
    within = hits_at_k(hits, ks)
    positive_counts = np.array([len(rows) for rows in positives], np.int64)
    findable = positive_counts > 0
    precisions = average_precisions(hits, positive_counts)[findable]
    findable_values = np.column_stack([within[findable], precisions])
    intervals = share_intervals(findable_values, clusters.labels[findable])
    curve = area = sure = None
    if scores is not None:
        curve = precision_recall(scores[:, 0], hits[:, 0], int(findable.sum()))
        area = auroc(scores[:, 0], hits[:, 0])
        sure = curve.recall_at(0.99) if curve else None
    return RetrievalMetrics(
        recalls=compute_recalls(ranked, positives, ks),
        hits=hits,
        within=within,
        recall_intervals=share_intervals(within, clusters.labels),
        findable_intervals=intervals[:-1] if intervals else None,
        mean_average_precision=float(precisions.mean()) if len(precisions) else float("nan"),
        map_interval=intervals[-1] if intervals else None,
        clusters=clusters,
        curve=curve,
        auroc=area,
        recall_at_99_precision=sure,
        metres=metres,
    )


def _intervals_by_k(
    ks: Sequence[int], intervals: list[ConfidenceInterval] | None
) -> dict[str, list[float]] | None:
    if intervals is None:
        return None
    return {str(k): interval.as_json() for k, interval in zip(ks, intervals, strict=True)}


def _curve_json(curve: PrecisionRecall | None) -> dict[str, Any] | None:
    if curve is None:
        return None
    count = len(curve.thresholds)
    shown = np.unique(np.linspace(0, count - 1, min(count, MAX_CURVE_POINTS)).round().astype(int))
    points = np.column_stack([curve.thresholds, curve.precision, curve.recall])[shown]
    names = ("score", "precision", "recall")
    return {
        "area": curve.area,
        "points": [dict(zip(names, point, strict=True)) for point in points.tolist()],
    }


def _nan_to_none(value: float) -> float | None:
    # JSON has no NaN.
    return None if np.isnan(value) else value
