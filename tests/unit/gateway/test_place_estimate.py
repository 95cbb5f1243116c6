"""From a ranking to a place: where it lies, and what the answer says of it."""

from __future__ import annotations

from uuid import UUID

import pytest

from services.gateway.schemas import EstimateResponse
from services.gateway.similarity.estimate import estimate_place, locate_hits
from shared.catalog.photos import Photo
from shared.evaluation.places.evidence import (
    PhotoLocation,
    RankedPhoto,
    estimate_location,
)
from shared.evaluation.places.levels import LevelScheme
from shared.evaluation.places.probability import PlaceModel
from shared.search_api.protocol import SearchHit

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
    return estimate_place(estimate, 0.95, RADIUS_M, "no place")


def fitted(limit: float | None) -> PlaceModel:
    return PlaceModel(source="own_photos", own_photos=100, in_map_limit=limit)


def test_before_an_evaluation_the_place_is_given_and_nothing_is_claimed_of_it() -> None:
    reported = answer(PlaceModel(), *EVERYTHING)
    assert (reported.in_map, reported.confidence, reported.calibration_source) == (None,) * 3
    assert reported.latitude == pytest.approx(45.0)
    assert reported.radius_m == RADIUS_M
    assert "not measured yet" in reported.reason


def test_too_few_evaluated_photos_leave_open_whether_the_place_is_in_the_map() -> None:
    reported = answer(fitted(None), *EVERYTHING)
    assert reported.in_map is None
    assert reported.confidence is not None
    assert "Too few photos" in reported.reason


def test_a_query_is_in_the_map_if_not_in_map_is_less_probable_than_the_limit() -> None:
    inside, outside = answer(fitted(1.0), *EVERYTHING), answer(fitted(0.0), *EVERYTHING)
    assert (inside.in_map, outside.in_map) == (True, False)
    assert inside.latitude is not None
    assert (outside.latitude, outside.longitude, outside.radius_m, outside.place) == (None,) * 4
    assert outside.reason.startswith("Probably not in this map")


def test_an_empty_ranking_gives_no_estimate() -> None:
    reported = answer(fitted(1.0))
    assert (reported.in_map, reported.latitude, reported.reason) == (None, None, "no place")


def test_a_filter_does_not_hide_photos_of_other_places_from_the_probabilities() -> None:
    alone = answer(fitted(1.0), EVERYTHING[0], whole_map=EVERYTHING)
    last = answer(fitted(1.0), EVERYTHING[2], whole_map=EVERYTHING)
    whole = answer(fitted(1.0), *EVERYTHING)
    assert alone.not_in_map_probability == whole.not_in_map_probability
    assert alone.confidence == whole.confidence
    assert last.confidence is not None
    assert alone.confidence is not None
    assert last.confidence < alone.confidence
