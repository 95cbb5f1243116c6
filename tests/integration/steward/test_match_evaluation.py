"""Evaluations with local features: whether their matches help a map, and what follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from services.steward.map_evaluation import MIN_PHOTOS_TO_DECIDE
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.evaluation.places.probability import PlaceModel
from shared.matching.features import LocalFeatures
from tests.integration.evaluated_map import EvaluatedMap
from tests.integration.steward.streets import at
from tests.support.local_features import add_features, scene_features

PLACES = 30
PER_PLACE = 4


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
    publish_clustered(city, noise_degrees=8.0)
    figures = city.figures()
    assert figures["uses_matches"] is True
    assert generation(city).uses_matches is True
    with_matches = model(city).with_matches
    assert with_matches is not None
    assert with_matches.own_photos >= MIN_PHOTOS_TO_DECIDE
    at_95 = {a["certainty"]: a for a in figures["places_with_matches"]["answers"]}[0.95]
    without = {a["certainty"]: a for a in figures["places"]["answers"]}[0.95]
    assert at_95["answered"]["mean"] > without["answered"]["mean"] + 0.03
    assert at_95["precision"]["mean"] >= 0.95
    for kind in ("leave_one_out", "leave_one_out_without_sequence"):
        by_similarity, by_matches = figures[kind], figures[f"{kind}_by_matches"]
        assert by_matches["R@10"] == by_similarity["R@10"]
        assert by_matches["R@1"] > by_similarity["R@1"]


def test_matches_that_tell_nothing_are_not_used(city: EvaluatedMap) -> None:
    publish_clustered(city, noise_degrees=8.0, one_scene=True)
    figures = city.figures()
    assert figures["uses_matches"] is False
    assert generation(city).uses_matches is False
    assert model(city).with_matches is None


@pytest.mark.parametrize(("matching", "used"), [(Matching.OFF, None), (Matching.ON, True)])
def test_the_maps_setting_decides_before_the_evaluation(
    city: EvaluatedMap, matching: Matching, used: bool | None
) -> None:
    publish_clustered(city, noise_degrees=8.0, one_scene=True)
    set_matching(city, matching)
    city.figures()
    assert generation(city).uses_matches is used
    assert (model(city).with_matches is not None) == bool(used)


def test_photos_without_features_leave_it_open(city: EvaluatedMap) -> None:
    publish_clustered(city, noise_degrees=8.0, with_features=False)
    figures = city.figures()
    assert (figures["uses_matches"], figures["places_with_matches"]) == (None, None)
    assert generation(city).uses_matches is None


def publish_clustered(
    city: EvaluatedMap, noise_degrees: float, *, one_scene: bool = False, with_features: bool = True
) -> None:
    """Photos of places at angles that overlap, with the points of their places."""
    rng = np.random.default_rng(0)
    numbers = range(PLACES * PER_PLACE)
    seen: list[tuple[float, dict[str, Any]]] = []
    for number in numbers:
        place, walk = number // PER_PLACE, "abcd"[number % PER_PLACE]
        angle = 360 / PLACES * place + noise_degrees * rng.normal()
        seen.append((angle, at(place, filename=f"{walk}{place}.jpg")))
    ids = city.publish(seen)
    if with_features:
        scenes = {
            photo_id: features_of(0 if one_scene else n // PER_PLACE, n)
            for n, photo_id in enumerate(ids)
        }
        add_features(city.catalog, city.store, scenes)
