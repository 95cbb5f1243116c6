"""AUROC and recall at a precision, counted by hand and over all pairs and thresholds."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as some

from lab.evaluation.confidence_metrics import auroc, recall_at_precision

YES, NO = True, False


def test_the_auroc_counts_pairs_in_the_right_order() -> None:
    assert auroc([0.9, 0.8, 0.2, 0.1], [YES, YES, NO, NO]) == 1
    assert auroc([0.9, 0.8, 0.2, 0.1], [NO, NO, YES, YES]) == 0
    assert auroc([0.9, 0.5, 0.4, 0.1], [YES, NO, YES, NO]) == 3 / 4
    assert auroc([0.5, 0.5, 0.5], [YES, NO, NO]) == 0.5, "a tie is half"
    assert auroc([0.5, 0.6], [YES, YES]) is None
    assert auroc([0.5, 0.6], [NO, NO]) is None


pairs = some.lists(
    some.tuples(some.sampled_from([0.0, 0.1, 0.25, 0.5, 0.9, 1.0]), some.booleans()),
    min_size=1,
    max_size=30,
)


@given(pairs)
def test_the_auroc_is_that_of_all_pairs(judged: list[tuple[float, bool]]) -> None:
    right = [reported for reported, ok in judged if ok]
    wrong = [reported for reported, ok in judged if not ok]
    found = auroc([reported for reported, _ in judged], [ok for _, ok in judged])
    if not right or not wrong:
        assert found is None
        return
    won = sum((r > w) + 0.5 * (r == w) for r in right for w in wrong)
    assert found == pytest.approx(won / (len(right) * len(wrong)))


def test_recall_at_a_precision_takes_the_lowest_cut_that_is_good_enough() -> None:
    reported = [0.9, 0.8, 0.7, 0.6, 0.5]
    right = [YES, YES, NO, YES, NO]
    assert recall_at_precision(reported, right, 4) == 2 / 4
    assert recall_at_precision(reported, right, 4, precision=0.75) == 3 / 4
    assert recall_at_precision(reported, right, 4, precision=0.7) == 3 / 4
    assert recall_at_precision(reported, right, 4, precision=0) == 3 / 4
    assert recall_at_precision([0.9, 0.8], [NO, YES], 1) == 0, "no cut is good enough"
    assert recall_at_precision(reported, right, 0) == 0
    assert recall_at_precision([0.5, 0.5, 0.4], [YES, NO, YES], 2) == 0, "ties go together"


@given(pairs, some.sampled_from([0.5, 0.9, 0.99]))
def test_recall_at_a_precision_is_the_best_over_all_cuts(
    judged: list[tuple[float, bool]], precision: float
) -> None:
    best = 0
    for cut, _ in judged:
        taken = [ok for reported, ok in judged if reported >= cut]
        if sum(taken) / len(taken) >= precision:
            best = max(best, sum(taken))
    found = recall_at_precision(
        [reported for reported, _ in judged], [ok for _, ok in judged], len(judged), precision
    )
    assert found == pytest.approx(best / len(judged))
