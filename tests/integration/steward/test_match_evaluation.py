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
from tests.integration.steward.streets import at
from tests.integration.town import Town
from tests.support.local_features import add_features, scene_features

pytestmark = pytest.mark.databases("sqlite")

PLACES = 30
PER_PLACE = 4


def features_of(place: int, number: int) -> LocalFeatures:
    return scene_features(place, view=0.1 * (number % PER_PLACE), points=40)


def set_matching(town: Town, matching: Matching) -> None:
    with town.catalog.write() as session:
        session.get_one(Map, town.map_id).matching = matching


def generation(town: Town) -> Generation:
    with town.catalog.read() as session:
        return session.get_one(Generation, town.generation_id)


def model(town: Town) -> PlaceModel:
    return PlaceModel.model_validate(town.calibration())


def test_a_map_uses_matches_where_they_answer_more(town: Town) -> None:
    publish_clustered(town, noise_degrees=8.0)
    figures = town.figures()
    assert figures["uses_matches"] is True
    assert generation(town).uses_matches is True
    with_matches = model(town).with_matches
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


def test_matches_that_tell_nothing_are_not_used(town: Town) -> None:
    publish_clustered(town, noise_degrees=8.0, one_scene=True)
    figures = town.figures()
    assert figures["uses_matches"] is False
    assert generation(town).uses_matches is False
    assert model(town).with_matches is None


@pytest.mark.parametrize(("matching", "used"), [(Matching.OFF, None), (Matching.ON, True)])
def test_the_maps_setting_decides_before_the_evaluation(
    town: Town, matching: Matching, used: bool | None
) -> None:
    publish_clustered(town, noise_degrees=8.0, one_scene=True)
    set_matching(town, matching)
    town.figures()
    assert generation(town).uses_matches is used
    assert (model(town).with_matches is not None) == bool(used)


def test_photos_without_features_leave_it_open(town: Town) -> None:
    publish_clustered(town, noise_degrees=8.0, with_features=False)
    figures = town.figures()
    assert (figures["uses_matches"], figures["places_with_matches"]) == (None, None)
    assert generation(town).uses_matches is None


def publish_clustered(
    town: Town, noise_degrees: float, *, one_scene: bool = False, with_features: bool = True
) -> None:
    """Photos of places at angles that overlap, with the points of their places."""
    rng = np.random.default_rng(0)
    numbers = range(PLACES * PER_PLACE)
    seen: list[tuple[float, dict[str, Any]]] = []
    for number in numbers:
        place, walk = number // PER_PLACE, "abcd"[number % PER_PLACE]
        angle = 360 / PLACES * place + noise_degrees * rng.normal()
        seen.append((angle, at(place, filename=f"{walk}{place}.jpg")))
    ids = town.publish(seen)
    if with_features:
        scenes = {
            photo_id: features_of(0 if one_scene else n // PER_PLACE, n)
            for n, photo_id in enumerate(ids)
        }
        add_features(town.catalog, town.store, scenes)
