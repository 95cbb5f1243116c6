"""Matches of a similarity search over HTTP: inliers, `rerank`, `explain`, and what is missing."""

from __future__ import annotations

from typing import Any
from uuid import UUID

import pytest

from shared.catalog.chunks import Chunk
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.matching.features import LocalFeatures
from shared.storage.chunks import features_key
from shared.storage.keys import query_features_key
from tests.integration.in_process_api import Service
from tests.support.local_features import SIZE, add_features, put_features, scene_features
from tests.support.photos import photo_bytes
from tests.support.problems import problem

PHOTOS = 5
NO_KEYPOINTS = LocalFeatures.empty(SIZE, 64)


@pytest.fixture
def ids(service: Service) -> list[str]:
    """Photos 1 and 3 are of scene 1, seen from ever farther away; photo 4 has no features."""
    ids = service.indexed(*range(PHOTOS))
    scenes = [scene_features(0), scene_features(1), scene_features(2), scene_features(1, 1.5)]
    add_features(service.catalog, service.store, dict(zip(map(UUID, ids), scenes, strict=False)))
    return ids


def set_up(service: Service, **columns: Any) -> None:
    """Set columns of the only map and generation."""
    with service.catalog.write() as session:
        for row in (session.query(Map).one(), session.query(Generation).one()):
            for name, value in columns.items():
                if hasattr(row, name):
                    setattr(row, name, value)


def ask(
    service: Service, features: LocalFeatures | None, number: int = 0, **params: Any
) -> dict[str, Any]:
    """The answer to a new photo that resembles photo `number`, and has these local features."""
    job_id = service.ask(photo_bytes(number), **params)
    service.drain()
    key = query_features_key(UUID(job_id))
    service.store.delete(key)
    if features is not None:
        put_features(service.store, features, key=key)
    answer: dict[str, Any] = service.json("GET", f"/jobs/{job_id}/result")
    return answer


def inliers_of(answer: dict[str, Any]) -> dict[str, Any]:
    return {photo["image_id"]: photo["inliers"] for photo in answer["similar_images"]}


def test_photos_have_inliers_and_the_answer_counts_those_without_features(
    service: Service, ids: list[str]
) -> None:
    plain = ask(service, scene_features(1, 0.2))
    assert plain["matches"] is None
    assert set(inliers_of(plain).values()) == {None}
    answer = ask(service, scene_features(1, 0.2), matches=10)
    found = inliers_of(answer)
    assert list(found) == list(inliers_of(plain)), "matches alone change no order"
    assert found[ids[1]] > 100
    assert found[ids[3]] > 20
    assert found[ids[0]] < 10
    assert found[ids[4]] is None
    width, height = SIZE
    assert answer["matches"] == {
        "compared": 4,
        "missing": 1,
        "reason": None,
        "query_width": width,
        "query_height": height,
    }
    assert answer["similar_images"][0]["pairs"] is None
    best = [
        photo["inliers"] for photo in ask(service, scene_features(1), matches=2)["similar_images"]
    ]
    assert sum(inliers is not None for inliers in best) <= 2


def test_rerank_orders_the_first_photos_by_their_inliers(service: Service, ids: list[str]) -> None:
    answer = ask(service, scene_features(1, 0.2), rerank=PHOTOS, top_k=4)
    order = list(inliers_of(answer))
    assert order[:2] == [ids[1], ids[3]]
    scores = {one["image_id"]: one["similarity_score"] for one in answer["similar_images"]}
    assert scores[ids[0]] == max(scores.values()), "another order than that of the similarity"
    every = list(inliers_of(ask(service, scene_features(1, 0.2), rerank=PHOTOS)))
    assert every[:4] == order
    assert every[4] == ids[4], "photos that can't be compared come last"
    two = ask(service, scene_features(1, 0.2), rerank=2)
    first = ask(service, scene_features(1, 0.2))
    assert list(inliers_of(two))[2:] == list(inliers_of(first))[2:], "the rest keeps its order"
    assert service.json("GET", "/searches")["searches"][0]["results"] == PHOTOS


def test_explain_returns_the_matching_points_of_a_stored_photo_at_once(
    service: Service, ids: list[str]
) -> None:
    params = {"explain": "true", "ids": f"{ids[3]},{ids[4]}"}
    answer = service.json("POST", f"/similarity/{ids[1]}", params=params)
    photos = {photo["image_id"]: photo for photo in answer["similar_images"]}
    pairs = photos[ids[3]]["pairs"]
    assert len(pairs) == photos[ids[3]]["inliers"] > 20
    for pair in pairs:
        for x, y in (pair["query"], pair["photo"]):
            assert -1 <= x <= SIZE[0] + 1
            assert -1 <= y <= SIZE[1] + 1
    assert photos[ids[4]]["pairs"] is None
    assert (answer["matches"]["compared"], answer["matches"]["missing"]) == (1, 1)


def test_matching_is_automatic_where_it_improves_the_answers(
    service: Service, ids: list[str]
) -> None:
    set_up(service, uses_matches=True)
    assert ask(service, scene_features(1))["matches"]["compared"] == 4
    assert ask(service, scene_features(1), matches=0)["matches"] is None
    # Those of the estimate count, too, which is that of the whole map.
    only = ask(service, scene_features(1), ids=ids[4])
    assert (only["matches"]["compared"], only["matches"]["missing"]) == (0, 1)


def test_query_without_usable_features_is_answered_with_the_reason(
    service: Service, ids: list[str]
) -> None:
    answer = ask(service, NO_KEYPOINTS, rerank=3, explain="true")
    assert len(answer["similar_images"]) == PHOTOS
    assert set(inliers_of(answer).values()) == {None}
    assert (answer["matches"]["compared"], answer["matches"]["missing"]) == (0, PHOTOS)
    assert "too little texture" in answer["matches"]["reason"]


def test_features_that_cannot_be_used_leave_the_answer_as_without_them(
    service: Service, ids: list[str]
) -> None:
    with service.catalog.read() as session:
        for chunk in session.query(Chunk):
            service.store.delete(features_key(chunk.object_key))
    plain, answer = (ask(service, scene_features(1), **params) for params in ({}, {"rerank": 5}))
    assert list(inliers_of(answer)) == list(inliers_of(plain))
    assert (answer["matches"]["compared"], answer["matches"]["missing"]) == (0, PHOTOS)


def test_map_without_matching_refuses_what_needs_it(service: Service, ids: list[str]) -> None:
    set_up(service, matching=Matching.OFF, uses_matches=True)
    for params in ({"rerank": 3}, {"explain": "true"}):
        problem(service("POST", f"/similarity/{ids[0]}", params=params), 422, "matching_off")
        files = {"file": ("query.jpg", photo_bytes(0))}
        problem(service("POST", "/similarity", params=params, files=files), 422, "matching_off")
    assert ask(service, None)["matches"] is None
    assert "`matching` is off" in ask(service, None, matches=5)["matches"]["reason"]
