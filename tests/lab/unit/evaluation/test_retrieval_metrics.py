"""The figures of an evaluation, on examples that can be worked out by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from lab.datasets.dataset import DatasetPhoto
from lab.evaluation.paired_runs import paired_differences
from lab.evaluation.query_clusters import cluster_queries, singleton_clusters
from lab.evaluation.ranking import compute_recalls
from lab.evaluation.recall import compute_hits, recall_at_k
from lab.evaluation.retrieval_metrics import (
    average_precisions,
    compute_metrics,
    distance_error,
    hits_at_k,
    match_distances,
    precision_recall,
)
from shared.evaluation.bootstrap import MIN_CLUSTERS, bootstrap_intervals, share_intervals

pytestmark = pytest.mark.numerics


def indices(*rows: list[int]) -> list[np.ndarray[Any, np.dtype[np.int64]]]:
    return [np.array(row, np.int64) for row in rows]


RANKED = np.array([[4, 1, 2], [3, 0, 1], [9, 8, 7], [5, 6, 0]])
POSITIVES = indices([4, 2], [1], [], [3])
"""right at ranks 1 and 3; at rank 3; nothing to find; not found"""


def shot(east: float | None = None, **fields: Any) -> DatasetPhoto:
    north = None if east is None else 5_000_000.0
    given: dict[str, Any] = {"easting": east, "northing": north, "zone": "32T", **fields}
    return DatasetPhoto(path=Path("photo.jpg"), name="photo.jpg", **given)


def test_recall_is_reported_with_and_without_queries_that_have_no_positive() -> None:
    found = compute_recalls(RANKED, POSITIVES, (1, 3))
    assert found.recall_all == {1: 1 / 4, 3: 2 / 4}
    assert found.recall_findable == {1: 1 / 3, 3: 2 / 3}
    assert (found.queries, found.without_positive) == (4, 1)
    assert math.isnan(recall_at_k(np.empty((0, 5), np.int64), [], (1,))[1]), "no query"
    with pytest.raises(ValueError, match="2 rankings for 1 queries"):
        recall_at_k(np.array([[0], [1]]), indices([0]))


def test_hits_stand_where_the_right_photos_are_ranked() -> None:
    hits = compute_hits(RANKED, POSITIVES)
    assert hits.astype(int).tolist() == [[1, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 0]]
    assert hits_at_k(hits, (1, 3)).tolist() == [[1, 1], [0, 1], [0, 0], [0, 0]]


def test_average_precision_is_that_of_the_textbook_cut_at_the_depth() -> None:
    hits = np.array([[1, 0, 1], [0, 0, 1], [1, 1, 1], [0, 0, 0]], bool)
    precisions = average_precisions(hits, np.array([2, 1, 50, 0]))
    # (1/1 + 2/3) / 2; (1/3) / 1; full marks although 47 positives lie deeper; nothing to find
    assert precisions[:3].tolist() == pytest.approx([5 / 6, 1 / 3, 1.0])
    assert math.isnan(precisions[3])


def test_precision_and_recall_go_by_the_score_and_equal_scores_are_believed_together() -> None:
    scores = np.array([0.9, 0.8, 0.8, 0.5, 0.4])
    right = np.array([True, True, False, False, True])
    curve = precision_recall(scores, right, queries_with_positive=4)
    assert curve is not None
    assert curve.thresholds.tolist() == [0.9, 0.8, 0.5, 0.4]
    assert curve.precision.tolist() == pytest.approx([1, 2 / 3, 2 / 4, 3 / 5])
    assert curve.recall.tolist() == [1 / 4, 2 / 4, 2 / 4, 3 / 4]
    assert curve.area == pytest.approx(1 / 4 * 1 + 1 / 4 * 2 / 3 + 0 + 1 / 4 * 3 / 5)
    assert precision_recall(scores, right, queries_with_positive=0) is None


def test_distance_error_counts_queries_whose_first_match_lies_within_x_metres() -> None:
    found = distance_error(np.array([0.0, 25.0, 25.1, 900.0, np.nan]))
    assert found is not None
    share = {entry["metres"]: entry["share"] for entry in found["within"]}
    assert (share[1], share[25], share[30], share[1000]) == (0.25, 0.5, 0.75, 1.0)
    assert (found["queries"], found["without_position"]) == (4, 1)
    assert found["median_m"] == pytest.approx(25.05)
    assert distance_error(np.array([np.nan])) is None


def test_each_ranked_photo_has_its_metres_from_its_own_query() -> None:
    queries = [shot(500_000.0), shot(500_100.0), shot(None)]
    database = [shot(500_030.0, northing=5_000_040.0), shot(500_000.0), shot(None)]
    metres = match_distances(queries, database, np.array([[0, 1, 2], [1, 0, 2], [0, 1, 2]]))
    assert metres[0, :2].tolist() == [50.0, 0.0]
    assert metres[1, :2].tolist() == pytest.approx([100.0, np.hypot(70, 40)])
    assert np.isnan(metres[:, 2]).all()
    assert np.isnan(metres[2]).all()


def test_queries_cluster_by_sequence_then_place_then_square() -> None:
    many = range(MIN_CLUSTERS)
    named = [shot(0.0, sequence=f"drive {n}", place="one") for n in many for _ in range(2)]
    assert cluster_queries(named).kind == "sequences"
    assert cluster_queries(named).labels.tolist() == [n for n in many for _ in range(2)]
    placed = [shot(0.0, place=f"place {n}") for n in many]
    assert cluster_queries(placed).kind == "places"
    apart = [shot(100.0 * n) for n in many]
    near = [shot(100.0 * n + 49.0) for n in many]
    assert cluster_queries([*apart, *near]).kind == "squares of 50 m"
    assert cluster_queries([*apart, *near]).labels.tolist() == [*many, *many]
    lost = [shot(None) for _ in many]
    assert cluster_queries(lost).kind == "queries"


def test_interval_is_that_of_the_binomial_where_queries_are_independent() -> None:
    values = (np.arange(400) < 100).astype(float)[:, None]
    found = bootstrap_intervals(values, np.arange(400))
    assert found is not None
    # 0.25 +- 1.96 * sqrt(0.25 * 0.75 / 400)
    assert found[0].low == pytest.approx(0.2076, abs=0.006)
    assert found[0].high == pytest.approx(0.2924, abs=0.006)
    assert bootstrap_intervals(values, np.arange(400) % (MIN_CLUSTERS - 1)) is None


def test_a_share_of_0_or_100_percent_has_the_interval_of_wilson_over_the_clusters() -> None:
    values = np.repeat([[0.0, 1.0, 0.0]], 40, axis=0)
    values[:20, 2] = 1.0
    for per_cluster in (1, 4):
        clusters = np.arange(40) // per_cluster
        found = share_intervals(values, clusters)
        bootstrap = bootstrap_intervals(values, clusters)
        assert found is not None
        assert bootstrap is not None
        count = 40 // per_cluster
        wilson = binomtest(0, count).proportion_ci(method="wilson")
        assert found[0].as_json() == pytest.approx([0.0, wilson.high], abs=1e-6)
        assert found[1].as_json() == pytest.approx([1 - wilson.high, 1.0], abs=1e-6)
        assert found[2] == bootstrap[2], "others are those of the bootstrap"
    assert share_intervals(values, np.arange(40) % (MIN_CLUSTERS - 1)) is None


def test_runs_are_compared_query_by_query() -> None:
    """Two runs that differ on 10 of 200 queries: far less than their own intervals are wide."""
    second = (np.arange(200) % 2).astype(float)[:, None]
    first = second.copy()
    first[:20:2] = 1.0
    (difference,) = paired_differences(first, second, np.arange(200))
    assert difference.mean == pytest.approx(0.05)
    assert (difference.won, difference.lost) == (10, 0)
    assert difference.is_significant
    assert difference.low is not None
    assert 0.01 < difference.low < 0.05
    own = bootstrap_intervals(first, np.arange(200))
    assert own is not None
    assert own[0].low < second.mean(), "the unpaired interval can't tell them apart"
    (same,) = paired_differences(second, second, np.arange(200))
    assert (same.mean, same.low, same.high, same.is_significant) == (0, 0, 0, False)
    with pytest.raises(ValueError, match="different shape"):
        paired_differences(np.ones((3, 1)), np.ones((4, 1)), np.arange(3))


def test_all_figures_of_a_ranking_come_together() -> None:
    scores = np.array([[0.9, 0.1, 0.1], [0.2, 0.1, 0.1], [0.3, 0.1, 0.1], [0.4, 0.1, 0.1]])
    metres = np.array([[3.0, 9, 9], [100, 9, 9], [200, 9, 9], [np.nan, 9, 9]])
    found = compute_metrics(
        RANKED, POSITIVES, singleton_clusters(4), scores=scores.astype(np.float32), metres=metres
    ).as_json()
    assert found["recall"] == {"1": 0.25}, "no k beyond the rankings' depth"
    assert found["recall_findable"] == {"1": pytest.approx(1 / 3)}
    assert found["recall_curve"] == [0.25, 0.25, 0.5]
    assert found["mean_average_precision"]["mean"] == pytest.approx((5 / 6 + 1 / 3 + 0) / 3)
    assert found["mean_average_precision"]["depth"] == 3
    assert found["recall_interval"] is None, "four clusters are too few"
    assert found["precision_recall"]["area"] == pytest.approx(1 / 3)
    assert found["distance_error"]["median_m"] == 100
    assert (found["auroc"], found["recall_at_99_precision"]) == (1.0, pytest.approx(1 / 3))
    assert found["intervals"]["clusters"] == "queries"
    json.dumps(found, allow_nan=False)


def test_figures_of_queries_without_any_positive_are_unknown_and_still_json() -> None:
    found = compute_metrics(RANKED, indices([], [], [], []), singleton_clusters(4)).as_json()
    assert found["recall"] == {"1": 0.0}
    assert found["recall_findable"] == {"1": None}
    assert found["mean_average_precision"]["mean"] is None
    assert found["precision_recall"] is None
    json.dumps(found, allow_nan=False)
