"""Evaluations with local features: whether their matches help a map, and what follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from services.steward import map_evaluation
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.evaluation.places.probability import PlaceModel
from shared.matching.features import LocalFeatures
from tests.integration.evaluated_map import EvaluatedMap
from tests.integration.steward.streets import at
from tests.support.local_features import add_features, scene_features

PLACES, FEW_PLACES = 30, 15
PER_PLACE = 4
NOISE_DEGREES = 8.0


def features_of(place: int, number: int) -> LocalFeatures:
    return scene_features(place, view=0.1 * (number % PER_PLACE), points=40)


def set_matching(city: EvaluatedMap, matching: Matching) -> None:
    with city.catalog.write() as session:
        session.get_one(Map, city.map_id).matching = matching


def generation(city: EvaluatedMap) -> Generation:
    with city.catalog.read() as session:
        return session.get_one(Generation, city.generation_id)


def model(city: EvaluatedMap) -> PlaceModel:
    return PlaceModel.model_validate(city.calibration())


def test_a_map_uses_matches_where_they_answer_more(city: EvaluatedMap) -> None:
    publish_clustered(city)
    figures = city.figures()
    assert figures["uses_matches"] is True
    assert generation(city).uses_matches is True
    with_matches = model(city).with_matches
    assert with_matches is not None
    assert with_matches.own_photos >= map_evaluation.MIN_PHOTOS_TO_DECIDE
    at_95 = {a["certainty"]: a for a in figures["places_with_matches"]["answers"]}[0.95]
    without = {a["certainty"]: a for a in figures["places"]["answers"]}[0.95]
    assert at_95["answered"]["mean"] > without["answered"]["mean"] + 0.03
    assert at_95["precision"]["mean"] >= 0.95
    for kind in ("leave_one_out", "leave_one_out_without_sequence"):
        by_similarity, by_matches = figures[kind], figures[f"{kind}_by_matches"]
        assert by_matches["R@10"] == by_similarity["R@10"]
        assert by_matches["R@1"] > by_similarity["R@1"]


@pytest.mark.parametrize(
    ("matching", "used"), [(Matching.OFF, None), (Matching.ON, True), (Matching.AUTO, False)]
)
def test_matches_with_which_fewer_are_answered_are_used_only_if_the_map_says_so(
    city: EvaluatedMap, monkeypatch: pytest.MonkeyPatch, matching: Matching, used: bool | None
) -> None:
    monkeypatch.setattr(map_evaluation, "answers_less", lambda without, with_matches: True)
    monkeypatch.setattr(map_evaluation, "MIN_PHOTOS_TO_DECIDE", FEW_PLACES * PER_PLACE)
    publish_clustered(city, FEW_PLACES)
    set_matching(city, matching)
    city.figures()
    assert generation(city).uses_matches is used
    assert (model(city).with_matches is not None) == bool(used)


def test_photos_without_features_leave_it_open(city: EvaluatedMap) -> None:
    publish_clustered(city, with_features=False)
    figures = city.figures()
    assert (figures["uses_matches"], figures["places_with_matches"]) == (None, None)
    assert generation(city).uses_matches is None


@pytest.mark.parametrize(("degrees", "scenes"), [(1, FEW_PLACES), (1, 1), (0, 1)])
def test_an_evaluation_measures_how_well_random_pairs_of_photos_of_different_places_match(
    city: EvaluatedMap, degrees: int, scenes: int
) -> None:
    publish_clustered(city, FEW_PLACES, scenes=scenes, degrees=degrees)
    set_matching(city, Matching.ON)
    city.figures()
    background = model(city).model_dump()["elsewhere"]["background"]
    assert (background["support"] > 20) == (scenes == degrees == 1)


def publish_clustered(
    city: EvaluatedMap,
    places: int = PLACES,
    *,
    with_features: bool = True,
    scenes: int = PLACES,
    degrees: int = 1,
) -> None:
    """Photos of places at angles that overlap, with the points of their places."""
    rng = np.random.default_rng(0)
    numbers = range(places * PER_PLACE)
    seen: list[tuple[float, dict[str, Any]]] = []
    for number in numbers:
        place, walk = number // PER_PLACE, "abcd"[number % PER_PLACE]
        angle = 360 / places * place + NOISE_DEGREES * rng.normal()
        seen.append((angle, at(degrees * place, filename=f"{walk}{place}.jpg")))
    ids = city.publish(seen)
    if with_features:
        features = {
            photo_id: features_of(n // PER_PLACE % scenes, n) for n, photo_id in enumerate(ids)
        }
        add_features(city.catalog, city.store, features)
