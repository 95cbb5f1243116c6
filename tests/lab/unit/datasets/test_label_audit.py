"""Answers that count as wrong and may be right: which are shown, and which are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lab.datasets.check import SuspectLabel, find_suspect_labels
from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.datasets.ground_truth import find_positives, parse_rule
from tests.lab.unit.data_sets import refused


def at(
    metres: float, name: str, heading: float | None = None, frame: int | None = None
) -> DatasetPhoto:
    return DatasetPhoto(
        Path(name), name, easting=metres, northing=0.0, heading=heading, frame=frame
    )


def evaluation(
    rule: str, database: list[DatasetPhoto], queries: list[DatasetPhoto]
) -> EvaluationSet:
    positives = tuple(find_positives(parse_rule(rule), queries, database))
    return EvaluationSet(
        "street", Path(), tuple(database), tuple(queries), positives, rule, "placewise"
    )


DATABASE = [at(metres, f"d{metres}") for metres in (0, 30, 100, 101, 1000)]


def suspects_of(ranked: list[int], scores: list[float] | None = None) -> list[tuple[int, str]]:
    """All queries stand at 0 m; the suspects' queries and first matches."""
    street = evaluation("radius 25 m", DATABASE, [at(0, f"q{n}") for n in range(len(ranked))])
    given = None if scores is None else np.array(scores, np.float32)[:, None]
    found = find_suspect_labels(street, np.array(ranked, np.int64)[:, None], given)
    return [(one.query, one.database_name) for one in found]


def test_wrong_first_match_up_to_four_times_the_radius_is_a_suspect() -> None:
    assert suspects_of([0, 1, 2, 3, 4]) == [(1, "d30"), (2, "d100")]


def test_only_matches_as_confident_as_the_median_right_one_count_most_confident_first() -> None:
    ranked, scores = [0, 0, 0, 1, 1, 1], [0.9, 0.7, 0.5, 0.8, 0.69, 0.95]
    assert suspects_of(ranked, scores) == [(5, "d30"), (3, "d30")]
    assert suspects_of([1, 1], [0.1, 0.2]) == [(1, "d30"), (0, "d30")]  # none is right: all count


def test_match_in_place_that_looks_another_way_is_a_suspect() -> None:
    street = evaluation(
        "heading 25 m 40 deg", [at(5, "back", heading=190)], [at(0, "query", heading=20)]
    )
    (suspect,) = find_suspect_labels(street, np.array([[0]]))
    assert suspect == SuspectLabel(0, 0, "query", "back", None, 5.0, 170.0)


def test_frames_just_outside_the_rule_are_suspects() -> None:
    database = [at(0, f"f{frame}", frame=frame) for frame in (12, 18, 19)]
    queries = [at(0, "q", frame=10)] * 3
    found = find_suspect_labels(
        evaluation("frames 2", database, queries), np.array([[0], [1], [2]])
    )
    assert [one.database_name for one in found] == ["f18"]


def test_predictions_of_other_queries_are_refused() -> None:
    with refused("predictions_of_other_queries"):
        find_suspect_labels(evaluation("radius", DATABASE, [at(0, "q")]), np.array([[0], [1]]))
