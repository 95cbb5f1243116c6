"""AUROC and recall at a precision, against all pairs and all thresholds."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as some

from lab.evaluation.confidence_metrics import auroc, recall_at_precision

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


@given(pairs, some.sampled_from([0.0, 0.5, 0.7, 0.99]))
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
    assert recall_at_precision([0.5], [True], 0) == 0, "no query can be right"
