"""From a ranking to a place: where it lies, and what the answer says of it."""

from __future__ import annotations

from uuid import UUID

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.gateway.similarity.estimate import estimate_place, locate_hits, place_at_pose
from shared.catalog.photos import Photo
from shared.evaluation.places.evidence import PhotoLocation, RankedPhoto, estimate_location
from shared.evaluation.places.levels import CandidateLevel, LevelScheme
from shared.evaluation.places.probability import (
    Background,
    Elsewhere,
    MapExtent,
    PlaceEstimate,
    PlaceModel,
    error_radius_m,
)
from shared.evaluation.places.thresholds import CERTAINTIES
from shared.responses.similarity import CameraPoseResponse, EstimateResponse
from shared.search_api.protocol import SearchHit
from tests.support.api_responses import POSE

pytestmark = pytest.mark.numerics

RADIUS_M = 25.0
DEGREE_M = 111_195.0  # of latitude, on the sphere


def north(metres: float, place: str | None = None) -> PhotoLocation:
    """So many metres north of a fixed point."""
    return PhotoLocation(45.0 + metres / DEGREE_M, 7.0, place)


def ranking(*pairs: tuple[float, PhotoLocation]) -> list[RankedPhoto]:
    return [RankedPhoto(score, spot) for score, spot in pairs]


# --- position --------------------------------------------------------------------------------


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


# --- the answer ------------------------------------------------------------------------------

SCHEME = LevelScheme(labels_are_paths=False, radii_m=(RADIUS_M,))
EVERYTHING = ((0.5, north(0)), (0.45, north(700)), (0.2, north(3000)))


def answer(
    model: PlaceModel,
    *found: tuple[float, PhotoLocation],
    whole_map: tuple[tuple[float, PhotoLocation], ...] | None = None,
) -> EstimateResponse:
    pairs = found if whole_map is None else whole_map
    photos = {
        UUID(int=n): Photo(
            id=UUID(int=n), latitude=spot.latitude, longitude=spot.longitude, place=spot.place
        )
        for n, (_, spot) in enumerate(pairs)
    }
    hits = [SearchHit(photo_id=UUID(int=n), score=score) for n, (score, _) in enumerate(pairs)]
    located = locate_hits(hits, photos)
    shown = [ranked for ranked in located if (ranked.score, ranked.location) in found]
    estimate = model.estimate(located, [], SCHEME, 0.95, RADIUS_M, shown)
    return estimate_place(estimate, 0.95, 0.33, "no place")


def fitted(log_odds: float) -> PlaceModel:
    """A model with the log-odds of "elsewhere" at a prior of one half."""
    elsewhere = Elsewhere(
        coefficients=(log_odds, 0.0, 0.0),
        matched=(0.0,) * 4,
        background=Background(mean=0.0, deviation=1.0),
    )
    extent = MapExtent(diameter_m=3000)
    return PlaceModel(source="own_photos", own_photos=100, elsewhere=elsewhere, extent=extent)


def test_before_an_evaluation_the_place_is_given_and_nothing_is_claimed_of_it() -> None:
    reported = answer(PlaceModel(), *EVERYTHING)
    assert (reported.in_map, reported.confidence, reported.calibration_source) == (None,) * 3
    assert reported.latitude == pytest.approx(45.0)
    assert "has not been measured" in reported.headline
    assert "not measured yet" in reported.reason


def test_a_query_is_in_the_map_elsewhere_or_neither_is_certain() -> None:
    inside, open_, outside = (answer(fitted(x), *EVERYTHING) for x in (-9.0, 0.0, 9.0))
    assert [each.in_map for each in (inside, open_, outside)] == [True, None, False]
    assert inside.latitude is not None
    assert open_.headline.startswith("Not certain. Best guess")
    assert (outside.latitude, outside.longitude, outside.radius_m, outside.place) == (None,) * 4
    assert outside.headline == "Probably not in this map: more than 99 %"


@given(
    probabilities=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4).map(sorted),
    certainty=st.sampled_from([0.5, 0.8, 0.95, 0.99]),
    of_labels=st.booleans(),
    pose_m=st.none() | st.floats(0.1, 3000),
    threshold=st.none() | st.floats(0.75, 1.0),
    wrong_until=st.none() | st.lists(st.floats(0.0, 1.0), min_size=40, max_size=40),
    mistaken=st.floats(0.0, 1.0),
    is_new=st.booleans(),
)
def test_headline_levels_and_fields_of_an_estimate_agree(
    probabilities: list[float],
    certainty: float,
    of_labels: bool,
    pose_m: float | None,
    threshold: float | None,
    wrong_until: list[float] | None,
    mistaken: float,
    is_new: bool,
) -> None:
    thresholds = () if threshold is None else (threshold,) * len(CERTAINTIES)
    guarantee = None if wrong_until is None else 0.05
    model = PlaceModel(
        source="own_photos",
        thresholds=thresholds,
        wrong_until=tuple(wrong_until or ()),
        mistaken=(mistaken,) * len(CERTAINTIES),
    )
    last = len(probabilities) - 1
    levels = [
        CandidateLevel(
            place=f"level {n}" if of_labels and n <= max(0, last - 1) else None,
            latitude=None if of_labels else 45.0,
            longitude=None if of_labels else 7.0,
            radius_m=None if of_labels else 25.0 * 4**n,
            is_whole_map=n == last,
        )
        for n in range(last + 1)
    ]
    missing = 1 - probabilities[-1]
    given_ = PlaceEstimate(
        model=model,
        location=PhotoLocation(None, None, "a") if of_labels else north(0),
        levels=levels,
        probabilities=probabilities,
        answer=model.answer(probabilities, missing, certainty, guarantee),
        not_in_map=missing,
        in_map=model.is_in_map(missing, certainty),
        radius_68_m=error_radius_m(levels, probabilities, 0.68),
        radius_95_m=error_radius_m(levels, probabilities, 0.95),
        match_probabilities=[],
    )
    told = estimate_place(given_, certainty, 0.33, "no place", is_new=is_new)
    if pose_m is not None:
        told = place_at_pose(told, pose(pose_m))
    stated = [level.probability for level in told.levels]
    assert stated == sorted(stated)
    assert told.not_in_map_probability == pytest.approx(1 - stated[-1])
    assert (told.radius_m is None) or told.latitude is not None, "a radius is that of a position"
    assert told.has_place is (told.latitude is not None or told.place is not None)
    if not told.answer_level and pose_m is None:
        assert ("No level reaches" in told.reason) is (told.in_map is None)
        assert ("Photos of elsewhere" in told.reason) is (told.in_map is False)
    if told.answer_level is not None:
        assert told.in_map
        least = model.threshold(certainty, guarantee)
        is_whole_map = told.levels[told.answer_level].whole_map
        assert stated[told.answer_level] >= min(certainty if is_whole_map else least, 0.95) - 1e-9
        assert all(p < max(least, 0.95) for p in stated[: told.answer_level])
    assert (told.in_map is True) is (told.answer_level is not None)
    assert told.new_to_map is is_new
    of_evidence = pose_m is None or of_labels
    assert ("new to this map" in told.reason) is (is_new and of_evidence)
    warned = told.answer_level is not None and mistaken > 1 - certainty and of_evidence
    assert ("look alike" in told.reason) is warned
    if told.in_map is False:
        assert (told.latitude, told.place, told.radius_m, told.confidence) == (None,) * 4
        assert told.answer_level is None
        assert told.has_place is False
        assert stated[-1] < 0.5
        assert told.headline.startswith("Probably not in this map")
    elif pose_m is not None and not of_labels:
        assert (told.latitude, told.radius_m) == (POSE_LATITUDE, pose_m)
        assert told.headline.startswith("Here, within")
        assert told.in_map
    else:
        shown = told.levels[told.answer_level or 0]
        assert (told.latitude, told.radius_m, told.place) == (
            shown.latitude, shown.radius_m, shown.place,
        )  # fmt: skip
        assert told.confidence == shown.probability
        assert told.headline.startswith("Not certain") is (told.answer_level is None)
        assert ("In this map" in told.headline) is (
            shown.whole_map and told.answer_level is not None
        )


POSE_LATITUDE = 45.00001


def pose(radius_95_m: float) -> CameraPoseResponse:
    fields = {"latitude": POSE_LATITUDE, "radius_68_m": radius_95_m / 2, "radius_95_m": radius_95_m}
    return CameraPoseResponse.model_validate(POSE | fields)


def test_an_empty_ranking_gives_no_estimate() -> None:
    reported = answer(fitted(-9.0))
    assert (reported.in_map, reported.latitude, reported.reason) == (None, None, "no place")


def test_a_filter_does_not_hide_photos_of_other_places_from_the_probabilities() -> None:
    alone = answer(fitted(-9.0), EVERYTHING[0], whole_map=EVERYTHING)
    last = answer(fitted(-9.0), EVERYTHING[2], whole_map=EVERYTHING)
    whole = answer(fitted(-9.0), *EVERYTHING)
    assert alone.not_in_map_probability == whole.not_in_map_probability
    assert alone.confidence == whole.confidence
    assert last.levels[0].probability < alone.levels[0].probability
