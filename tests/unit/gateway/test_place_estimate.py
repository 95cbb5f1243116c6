"""From a ranking to a place: what speaks for it, where it lies, what the answer says of it."""

from __future__ import annotations

from collections.abc import Callable
from uuid import UUID

import numpy as np
import pytest
from numpy.typing import NDArray

from services.gateway.schemas import EstimateResponse
from services.gateway.similarity.estimate import estimate_place, locate_hits
from shared.catalog.photos import Photo
from shared.evaluation.calibration import (
    FALSE_ACCEPT_RATE,
    MIN_IMPOSTORS,
    Calibration,
    fit_confidence,
    fit_threshold,
)
from shared.evaluation.places.evidence import (
    PhotoLocation,
    PlaceEvidence,
    RankedPhoto,
    compute_evidence,
    estimate_location,
    is_different_place,
    is_same_place,
)
from shared.search_api.protocol import SearchHit

pytestmark = pytest.mark.numerics

RADIUS_M = 25.0
DEGREE_M = 111_195.0  # of latitude, on the sphere


def north(metres: float, place: str | None = None) -> PhotoLocation:
    """So many metres north of a fixed point."""
    return PhotoLocation(45.0 + metres / DEGREE_M, 7.0, place)


def ranking(*pairs: tuple[float, PhotoLocation]) -> list[RankedPhoto]:
    return [RankedPhoto(score, spot) for score, spot in pairs]


# --- places ----------------------------------------------------------------------------------


def test_near_photos_and_photos_of_one_label_show_one_place() -> None:
    assert is_same_place(north(0), north(24.9), RADIUS_M)
    assert not is_same_place(north(0), north(25.2), RADIUS_M)
    assert is_same_place(
        PhotoLocation(None, None, "lab"), PhotoLocation(None, None, "lab"), RADIUS_M
    )
    assert is_same_place(north(0, "square"), north(80, "square"), RADIUS_M)
    assert not is_same_place(
        PhotoLocation(None, None, None), PhotoLocation(None, None, None), RADIUS_M
    )
    assert not is_same_place(north(0), PhotoLocation(None, None, "lab"), RADIUS_M)


def test_between_the_radius_and_a_hundred_metres_lies_neither() -> None:
    assert not is_different_place(north(0), north(60))
    assert not is_same_place(north(0), north(60), RADIUS_M)
    assert is_different_place(north(0), north(101))


def test_another_label_is_elsewhere_only_where_coordinates_do_not_say_otherwise() -> None:
    assert is_different_place(
        PhotoLocation(None, None, "lab"), PhotoLocation(None, None, "kitchen")
    )
    assert not is_different_place(north(0, "lab"), north(30, "kitchen"))
    assert is_different_place(north(0, "lab"), north(300, "kitchen"))
    assert not is_different_place(north(0, "park"), north(300, "park"))
    assert not is_different_place(north(0), PhotoLocation(None, None, "lab"))


# --- evidence --------------------------------------------------------------------------------


def test_support_adds_up_what_agreeing_photos_are_ahead_of_the_best_other_place() -> None:
    found = compute_evidence(
        ranking((0.5, north(0)), (0.45, north(10)), (0.3, north(500)), (0.2, north(5))), RADIUS_M
    )
    assert found is not None
    # 0.5 and 0.45 lead 0.3; the last agrees but is behind it, and takes nothing away.
    assert found.support == pytest.approx(0.2 + 0.15)
    assert found.agreement == pytest.approx(3 / 4)


def test_what_is_neither_here_nor_elsewhere_is_no_rival() -> None:
    found = compute_evidence(
        ranking((0.5, north(0)), (0.49, north(60)), (0.1, north(900))), RADIUS_M
    )
    assert found is not None
    assert found.support == pytest.approx(0.4)


def test_without_a_rival_in_sight_the_last_photo_stands_for_it() -> None:
    found = compute_evidence(ranking((0.5, north(0)), (0.4, north(1)), (0.3, north(2))), RADIUS_M)
    assert found is not None
    assert found.support == pytest.approx(0.2 + 0.1)


def test_a_ranking_without_a_place_gives_no_evidence() -> None:
    nowhere = PhotoLocation(None, None, None)
    assert compute_evidence([], RADIUS_M) is None
    assert compute_evidence(ranking((0.9, nowhere), (0.8, north(0))), RADIUS_M) is None


def test_the_estimate_lies_between_the_photos_near_the_best_nearer_to_the_better() -> None:
    found = estimate_location(
        ranking((0.5, north(0)), (0.4, north(10)), (0.35, north(400)), (0.3, north(900))), RADIUS_M
    )
    assert found.latitude is not None
    metres = (found.latitude - 45.0) * DEGREE_M
    assert metres == pytest.approx(10 * 0.1 / (0.2 + 0.1), abs=0.01)


def test_the_estimate_between_two_sides_of_the_antimeridian_stays_there() -> None:
    sides = ranking(
        (0.5, PhotoLocation(0.0, 179.9999, None)), (0.5, PhotoLocation(0.0, -179.9999, None))
    )
    found = estimate_location(sides, RADIUS_M)
    assert found.longitude is not None
    assert abs(abs(found.longitude) - 180.0) < 1e-9


def test_a_label_is_the_best_photos_label() -> None:
    found = estimate_location(
        ranking((0.5, PhotoLocation(None, None, "lab")), (0.4, PhotoLocation(None, None, "hall"))),
        RADIUS_M,
    )
    assert found == PhotoLocation(None, None, "lab")


# --- calibration -----------------------------------------------------------------------------


def test_one_new_impostor_in_twenty_passes_the_threshold_whatever_their_distribution() -> None:
    rng = np.random.default_rng(0)
    draws: tuple[Callable[[int], NDArray[np.float64]], ...] = (
        lambda size: rng.exponential(size=size),
        lambda size: rng.standard_normal(size=size),
        lambda size: rng.pareto(1.5, size=size),
    )
    for draw in draws:
        shares = []
        for _ in range(300):
            seen = [PlaceEvidence(support, 0.1) for support in draw(100)]
            threshold = fit_threshold(seen)
            assert threshold is not None
            shares.append(float(np.mean(draw(200) > threshold)))
        assert np.mean(shares) <= FALSE_ACCEPT_RATE + 0.005


def test_too_few_impostors_give_no_threshold() -> None:
    few = [PlaceEvidence(0.1, 0.1)] * (MIN_IMPOSTORS - 1)
    assert fit_threshold(few) is None
    assert fit_threshold([*few, PlaceEvidence(0.2, 0.1)]) is not None


def labelled(count: int, seed: int = 0) -> list[tuple[PlaceEvidence, bool]]:
    """Queries whose true P(right) is a logistic function of their support."""
    rng = np.random.default_rng(seed)
    supports = rng.uniform(0, 0.4, count)
    right = rng.random(count) < 1 / (1 + np.exp(-(supports - 0.15) * 25))
    return [
        (PlaceEvidence(float(s), float(min(1.0, s + 0.2))), bool(ok))
        for s, ok in zip(supports, right, strict=True)
    ]


def test_the_confidence_recovers_the_probability_that_made_the_labels() -> None:
    learnt = fit_confidence(labelled(5000))
    assert learnt is not None
    for support in (0.05, 0.15, 0.3):
        truth = 1 / (1 + np.exp(-(support - 0.15) * 25))
        assert learnt.probability(PlaceEvidence(support, support + 0.2)) == pytest.approx(
            truth, abs=0.03
        )


def test_labels_that_separate_perfectly_give_a_finite_confidence() -> None:
    pairs = [(PlaceEvidence(x, x), x > 0.5) for x in np.linspace(0, 1, 100).tolist()]
    learnt = fit_confidence(pairs)
    assert learnt is not None
    assert 0.5 < learnt.probability(PlaceEvidence(0.9, 0.9)) < 1.0
    assert 0.0 < learnt.probability(PlaceEvidence(0.1, 0.1)) < 0.5


def test_evidence_that_never_varies_does_not_break_the_fit() -> None:
    learnt = fit_confidence([(PlaceEvidence(0.1, 0.1), i % 2 == 0) for i in range(60)])
    assert learnt is not None
    assert learnt.probability(PlaceEvidence(0.1, 0.1)) == pytest.approx(0.5)


def test_too_few_labels_or_only_one_kind_stay_uncalibrated() -> None:
    assert fit_confidence(labelled(39)) is None
    assert fit_confidence([(PlaceEvidence(0.1, 0.1), True)] * 100) is None


# --- the answer ------------------------------------------------------------------------------


def photo(number: int, spot: PhotoLocation) -> Photo:
    return Photo(
        id=UUID(int=number), latitude=spot.latitude, longitude=spot.longitude, place=spot.place
    )


def answer(
    calibration: Calibration | None, *pairs: tuple[float, PhotoLocation]
) -> EstimateResponse:
    photos = {UUID(int=n): photo(n, spot) for n, (_, spot) in enumerate(pairs)}
    hits = [SearchHit(photo_id=UUID(int=n), score=score) for n, (score, _) in enumerate(pairs)]
    ranked = locate_hits(hits, photos)
    return estimate_place(calibration, ranked, ranked, RADIUS_M, "no place")


def calibration(threshold: float | None) -> Calibration:
    return Calibration(radius_m=RADIUS_M, support_threshold=threshold, impostors=100)


PAIRS = ((0.5, north(0)), (0.2, north(700)))


def test_before_an_evaluation_the_place_is_given_and_nothing_is_claimed_of_it() -> None:
    for known in (None, calibration(None)):
        reported = answer(known, *PAIRS)
        assert (reported.in_map, reported.confidence, reported.calibration_source) == (None,) * 3
        assert reported.latitude == pytest.approx(45.0)
        assert reported.radius_m == RADIUS_M


def test_support_over_the_threshold_is_in_the_map_and_under_it_is_not() -> None:
    inside, outside = answer(calibration(0.29), *PAIRS), answer(calibration(0.31), *PAIRS)
    assert (inside.in_map, outside.in_map) == (True, False)
    assert inside.latitude is not None
    assert (outside.latitude, outside.longitude, outside.radius_m, outside.place) == (None,) * 4
    assert outside.reason.startswith("Probably not in this map")


def test_an_empty_ranking_gives_no_estimate() -> None:
    everything = ranking((0.5, north(0)))
    reported = estimate_place(calibration(0.1), [], everything, RADIUS_M, "no place")
    assert (reported.in_map, reported.latitude, reported.reason) == (None, None, "no place")


def test_a_filter_that_leaves_no_rival_makes_nobody_sure() -> None:
    everything = ranking((0.5, north(0)), (0.45, north(700)), (0.2, north(3000)))
    filtered = [everything[2]]
    known = calibration(0.01)
    reported = estimate_place(known, filtered, everything, RADIUS_M, "no place")
    assert reported.in_map is False
    alone = estimate_place(known, everything[:1], everything, RADIUS_M, "no place")
    whole = estimate_place(known, everything, everything, RADIUS_M, "no place")
    assert alone.in_map is whole.in_map is True
