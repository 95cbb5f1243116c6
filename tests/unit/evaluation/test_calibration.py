"""How good stated probabilities are, counted by hand; which photos show one place."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from shared.evaluation.calibration import expected_calibration_error
from shared.evaluation.places.evidence import PhotoLocation, distance_between_m, is_same_place

YES, NO = True, False


# --- figures ---------------------------------------------------------------------------------


def test_the_calibration_error_is_the_mean_gap_of_bins_of_equally_many() -> None:
    """What one bin says too much does not make up for what another says too little."""
    assert expected_calibration_error([0.9] * 4, [YES, YES, YES, NO]) == pytest.approx(0.15)
    assert expected_calibration_error([0.25] * 4, [YES, NO, NO, NO]) == pytest.approx(0)
    assert expected_calibration_error([1.0], [NO]) == 1
    assert expected_calibration_error([0.5], [YES]) == 0.5
    reported = [0.2] * 10 + [0.8] * 10
    truth = [YES] * 4 + [NO] * 6 + [YES] * 6 + [NO] * 4
    assert expected_calibration_error(reported, truth) == pytest.approx(0.2)
    mixed = [pair for both in zip(range(10), range(10, 20), strict=True) for pair in both]
    mixed_error = expected_calibration_error(
        [reported[i] for i in mixed], [truth[i] for i in mixed]
    )
    assert mixed_error == pytest.approx(0.2)


# --- places ----------------------------------------------------------------------------------

DEGREE_M = 111_195.08
metres_north = some.floats(0, 300)


PAIRS: dict[str, tuple[PhotoLocation, PhotoLocation, bool]] = {
    "one spot": (PhotoLocation(0, 0, None), PhotoLocation(0, 0, None), True),
    "one label, far apart": (PhotoLocation(0, 0, "a"), PhotoLocation(50, 0, "a"), True),
    "two labels, one spot": (PhotoLocation(0, 0, "a"), PhotoLocation(0, 0, "b"), True),
    "two labels, two spots": (PhotoLocation(0, 0, "a"), PhotoLocation(1, 0, "b"), False),
    "two rooms": (PhotoLocation(None, None, "a"), PhotoLocation(None, None, "b"), False),
    "incomparable": (PhotoLocation(None, None, "a"), PhotoLocation(0, 0, None), False),
    "unknown": (PhotoLocation(None, None, None), PhotoLocation(0, 0, "a"), False),
    "nothing": (PhotoLocation(None, None, None), PhotoLocation(None, None, None), False),
}


@pytest.mark.parametrize(("one", "other", "same"), PAIRS.values(), ids=PAIRS.keys())
def test_labels_and_distances_decide_whether_photos_are_of_one_place(
    one: PhotoLocation, other: PhotoLocation, same: bool
) -> None:
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
