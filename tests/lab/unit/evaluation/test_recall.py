"""recall@k by position, on examples small enough to do by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.evaluation.recall import positives_within, rank_by_similarity, recall_at_k


def indices(*rows: list[int]) -> list[np.ndarray[tuple[int], np.dtype[np.int64]]]:
    return [np.array(row, np.int64) for row in rows]


def test_positive_lies_within_25_metres_the_25th_included() -> None:
    queries = np.array([[0.0, 0.0], [1000.0, 0.0]])
    database = np.array([[25.0, 0.0], [25.01, 0.0], [15.0, 20.0], [18.0, 18.0]])
    first, second = positives_within(queries, database)
    assert first.tolist() == [0, 2]
    assert second.tolist() == []


def test_positives_are_the_same_for_any_number_of_queries_at_once() -> None:
    queries = np.random.default_rng(0).uniform(0, 300, (700, 2))
    database = np.random.default_rng(1).uniform(0, 300, (90, 2))
    together = positives_within(queries, database)
    one_by_one = [positives_within(query[None], database)[0] for query in queries]
    assert [found.tolist() for found in together] == [found.tolist() for found in one_by_one]


def test_ranking_is_by_cosine_and_a_tie_goes_to_the_lower_index() -> None:
    database = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 0.0], [0.6, 0.8]], np.float32)
    ranked = rank_by_similarity(np.array([[1.0, 0.0]], np.float32), database, 4)
    assert ranked.tolist() == [[1, 2, 3, 0]]


def test_ranking_is_no_longer_than_the_database() -> None:
    rows = np.eye(3, dtype=np.float32)
    assert rank_by_similarity(rows, rows, 10).shape == (3, 3)
    assert rank_by_similarity(rows[:0], rows, 2).shape == (0, 2)


def test_recall_counts_queries_with_a_positive_among_the_first_k() -> None:
    ranked = np.array([[4, 1, 2], [3, 0, 1], [9, 8, 7], [5, 6, 0]])
    positives = indices([4, 2], [1], [7], [3])
    assert recall_at_k(ranked, positives, (1, 2, 3)) == {1: 0.25, 2: 0.25, 3: 0.75}


def test_query_without_positives_counts_as_missed() -> None:
    assert recall_at_k(np.array([[0], [0]]), indices([0], []), (1,)) == {1: 0.5}


def test_recall_of_no_query_is_not_a_number() -> None:
    assert math.isnan(recall_at_k(np.empty((0, 5), np.int64), [], (1,))[1])


def test_rankings_and_positives_must_be_of_the_same_queries() -> None:
    with pytest.raises(ValueError, match="2 rankings for 1 queries"):
        recall_at_k(np.array([[0], [1]]), indices([0]))
