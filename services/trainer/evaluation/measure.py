"""Every figure of one answered evaluation set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.average_precision import average_precisions
from services.trainer.evaluation.bootstrap import (
    CONFIDENCE_LEVEL,
    RESAMPLES,
    ConfidenceInterval,
    bootstrap_intervals,
)
from services.trainer.evaluation.calibration import ScoreCalibration, calibrate_scores
from services.trainer.evaluation.clusters import QueryClusters
from services.trainer.evaluation.distance_error import distance_error
from services.trainer.evaluation.hits import Hits, compute_hits, hits_at_k
from services.trainer.evaluation.metres import Distances
from services.trainer.evaluation.nearest import Indices, Scores
from services.trainer.evaluation.precision_recall import PrecisionRecall, precision_recall
from services.trainer.evaluation.recalls import DEFAULT_KS, Recalls, compute_recalls

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
