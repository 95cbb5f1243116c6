"""How good stated probabilities are, counted by hand; which photos show one place."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from shared.evaluation.calibration import (
    auroc,
    expected_calibration_error,
    recall_at_precision,
)
from shared.evaluation.places.evidence import (
    PhotoLocation,
    distance_between_m,
    is_same_place,
)

YES, NO = True, False


# --- figures ---------------------------------------------------------------------------------


def test_the_calibration_error_of_one_bin_is_the_gap_between_stated_and_true() -> None:
    assert expected_calibration_error([0.9] * 4, [YES, YES, YES, NO]) == pytest.approx(0.15)
    assert expected_calibration_error([0.25] * 4, [YES, NO, NO, NO]) == pytest.approx(0)
    assert expected_calibration_error([1.0], [NO]) == 1
    assert expected_calibration_error([0.5], [YES]) == 0.5


def test_the_calibration_error_is_the_mean_over_bins_of_equally_many() -> None:
    """Two bins of ten: what one says too much does not make up for what the other says too
    little."""
    reported = [0.2] * 10 + [0.8] * 10
    truth = [YES] * 4 + [NO] * 6 + [YES] * 6 + [NO] * 4
    assert expected_calibration_error(reported, truth) == pytest.approx(0.2)
    mixed = [pair for both in zip(range(10), range(10, 20), strict=True) for pair in both]
    assert expected_calibration_error(
        [reported[i] for i in mixed], [truth[i] for i in mixed]
    ) == pytest.approx(0.2)


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


# --- places ----------------------------------------------------------------------------------

DEGREE_M = 111_195.08
metres_north = some.floats(0, 300)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        pytest.param(PhotoLocation(0, 0, None), PhotoLocation(0, 0, None), True, id="one spot"),
        pytest.param(
            PhotoLocation(0, 0, "a"),
            PhotoLocation(50, 0, "a"),
            True,
            id="one label, far apart",
        ),
        pytest.param(
            PhotoLocation(0, 0, "a"),
            PhotoLocation(0, 0, "b"),
            True,
            id="two labels, one spot",
        ),
        pytest.param(
            PhotoLocation(0, 0, "a"),
            PhotoLocation(1, 0, "b"),
            False,
            id="two labels, two spots",
        ),
        pytest.param(
            PhotoLocation(None, None, "a"),
            PhotoLocation(None, None, "b"),
            False,
            id="two rooms",
        ),
        pytest.param(
            PhotoLocation(None, None, "a"),
            PhotoLocation(0, 0, None),
            False,
            id="incomparable",
        ),
        pytest.param(
            PhotoLocation(None, None, None), PhotoLocation(0, 0, "a"), False, id="unknown"
        ),
        pytest.param(
            PhotoLocation(None, None, None),
            PhotoLocation(None, None, None),
            False,
            id="nothing",
        ),
    ],
)
def test_which_photos_show_one_place(one: PhotoLocation, other: PhotoLocation, same: bool) -> None:
    for here, there in ((one, other), (other, one)):
        assert is_same_place(here, there, 25) == same


@settings(max_examples=50)
@given(metres_north)
def test_photos_within_the_radius_show_one_place(metres: float) -> None:
    here, there = PhotoLocation(0, 7, None), PhotoLocation(metres / DEGREE_M, 7, None)
    found = distance_between_m(here, there)
    assert found == pytest.approx(metres, abs=0.01)
    if abs(metres - 25) > 0.1:
        assert is_same_place(here, there, 25) == (metres < 25)
