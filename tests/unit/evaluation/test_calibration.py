"""How good a confidence is, counted by hand, and what may be learnt from how little."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from shared.evaluation.calibration import (
    auroc,
    expected_calibration_error,
    fit_confidence,
    fit_threshold,
    recall_at_precision,
)
from shared.evaluation.places.evidence import (
    DIFFERENT_PLACE_M,
    PhotoLocation,
    PlaceEvidence,
    distance_between_m,
    is_different_place,
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


# --- what may be learnt ----------------------------------------------------------------------


def some_evidence(count: int, seed: int = 0, shift: float = 0.0) -> list[PlaceEvidence]:
    rows = np.random.default_rng(seed).normal(shift, 1, (count, len(fields(PlaceEvidence))))
    return [PlaceEvidence(*row) for row in rows.tolist()]


def test_a_threshold_wants_enough_impostors() -> None:
    assert fit_threshold(some_evidence(19)) is None
    assert fit_threshold(some_evidence(20)) is not None
    assert fit_threshold([]) is None


@pytest.mark.parametrize("impostors", [20, 39, 60, 300])
def test_about_one_in_twenty_strangers_is_accepted_and_no_more(impostors: int) -> None:
    """On average over many maps; of a uniform figure a share of 1 - t exceeds the threshold t."""
    chance = np.random.default_rng(impostors)
    exceeding = []
    for _ in range(400):
        drawn = chance.uniform(0, 1, impostors)
        threshold = fit_threshold([PlaceEvidence(*[x] * len(fields(PlaceEvidence))) for x in drawn])
        assert threshold is not None
        exceeding.append(1 - threshold)
    assert 0.03 < np.mean(exceeding) < 0.055


def test_no_confidence_is_learnt_from_too_few_or_of_one_kind() -> None:
    evidence = some_evidence(60)
    for judged in (
        [(e, n % 2 == 0) for n, e in enumerate(evidence[:39])],
        [(e, True) for e in evidence],
        [(e, False) for e in evidence],
        [(e, n >= 7) for n, e in enumerate(evidence)],
        [(e, n < 7) for n, e in enumerate(evidence)],
        [],
    ):
        assert fit_confidence(judged) is None
    assert fit_confidence([(e, n % 2 == 0) for n, e in enumerate(evidence)]) is not None


def test_a_confidence_separates_right_from_wrong_and_stays_between_0_and_1() -> None:
    """Also where both kinds are apart, which a fit without a ridge would follow for ever."""
    for apart in (1.0, 50.0):
        judged = [(e, True) for e in some_evidence(40, 1, apart)]
        judged += [(e, False) for e in some_evidence(40, 2, -apart)]
        learnt = fit_confidence(judged)
        assert learnt is not None
        reported = [learnt.probability(e) for e, _ in judged]
        assert all(0 < p < 1 for p in reported)
        found = auroc(reported, [ok for _, ok in judged])
        assert found is not None
        assert found > 0.9


# --- places ----------------------------------------------------------------------------------

DEGREE_M = 111_195.08
metres_north = some.floats(0, 300)


@pytest.mark.parametrize(
    ("one", "other", "same", "apart"),
    [
        pytest.param(
            PhotoLocation(0, 0, None), PhotoLocation(0, 0, None), True, False, id="one spot"
        ),
        pytest.param(
            PhotoLocation(0, 0, "a"),
            PhotoLocation(50, 0, "a"),
            True,
            False,
            id="one label, far apart",
        ),
        pytest.param(
            PhotoLocation(0, 0, "a"),
            PhotoLocation(0, 0, "b"),
            True,
            False,
            id="two labels, one spot",
        ),
        pytest.param(
            PhotoLocation(0, 0, "a"),
            PhotoLocation(1, 0, "b"),
            False,
            True,
            id="two labels, two spots",
        ),
        pytest.param(
            PhotoLocation(None, None, "a"),
            PhotoLocation(None, None, "b"),
            False,
            True,
            id="two rooms",
        ),
        pytest.param(
            PhotoLocation(None, None, "a"),
            PhotoLocation(0, 0, None),
            False,
            False,
            id="incomparable",
        ),
        pytest.param(
            PhotoLocation(None, None, None), PhotoLocation(0, 0, "a"), False, False, id="unknown"
        ),
        pytest.param(
            PhotoLocation(None, None, None),
            PhotoLocation(None, None, None),
            False,
            False,
            id="nothing",
        ),
    ],
)
def test_which_photos_show_one_place(
    one: PhotoLocation, other: PhotoLocation, same: bool, apart: bool
) -> None:
    for here, there in ((one, other), (other, one)):
        assert is_same_place(here, there, 25) == same
        assert is_different_place(here, there) == apart


@settings(max_examples=50)
@given(metres_north)
def test_between_near_and_far_is_neither(metres: float) -> None:
    here, there = PhotoLocation(0, 7, None), PhotoLocation(metres / DEGREE_M, 7, None)
    found = distance_between_m(here, there)
    assert found == pytest.approx(metres, abs=0.01)
    if abs(metres - 25) > 0.1 and abs(metres - DIFFERENT_PLACE_M) > 0.1:
        assert is_same_place(here, there, 25) == (metres < 25)
        assert is_different_place(here, there) == (metres > DIFFERENT_PLACE_M)
