"""Levels of an estimate over HTTP: in maps whose labels are paths, and in others."""

from __future__ import annotations

from typing import Any

import pytest
from PIL import Image

from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map
from shared.evaluation.places.probability import PlaceModel
from shared.search_api.protocol import SearchRequest, SearchResponse
from tests.integration.in_process_api import Service
from tests.support.photos import encoded, photo_bytes
from tests.support.problems import problem

PATHS = ("tower/7/lift", "tower/7/hall", "tower/8/lift", "tower//attic", "tower", "a")


def ask(service: Service, number: int, map_name: str = "default", **params: Any) -> Any:
    job_id = service.ask(photo_bytes(number), map_name, **params)
    service.drain()
    return service.json("GET", f"/jobs/{job_id}/result", params={"map": map_name})


def fit(service: Service, map_name: str = "default", **values: Any) -> None:
    """Store a place model as an evaluation of 20 photos would, with the prior's coefficients."""
    model = PlaceModel(source="own_photos", own_photos=20, **values)
    with service.catalog.write() as session:
        generation = active_generation(session, get_map(session, map_name).id)
        assert generation is not None
        generation.calibration = model.model_dump(mode="json")


@pytest.fixture
def tower(service: Service) -> Service:
    body = {"name": "tower", "place_labels_are_paths": True}
    assert service.json("POST", "/maps", 201, json=body)["place_labels_are_paths"] is True
    for number, place in enumerate(PATHS):
        service.upload(photo_bytes(number), "tower", place=place)
    service.drain()
    fit(service, "tower")
    return service


def test_a_map_without_an_evaluation_states_no_certainty(service: Service) -> None:
    """Of one photo, the prior would be certain whatever the query shows."""
    for number in range(2):
        service.upload(photo_bytes(number), place=f"room {number}")
        service.drain()
        answer = ask(service, 0, certainty=0.01)
        estimate = answer["estimate"]
        assert (estimate["levels"], estimate["answer_level"]) == ([], None)
        assert (estimate["calibration_source"], estimate["certainty"]) == (None, None)
        assert estimate["reason"].startswith("How certain this place is, and whether it is in")
        assert estimate["place"] == "room 0"
        assert answer["similar_images"][0]["match_probability"] is None


def test_a_photo_of_one_colour_is_not_answered_as_if_the_map_were_empty(service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": "small", "extractor": "patchnorm"})
    service.upload(photo_bytes(0), "small")
    job_id = service.ask(encoded(Image.new("RGB", (64, 48), "grey"), "PNG"), "small")
    service.drain()
    answer = service.json("GET", f"/jobs/{job_id}/result", params={"map": "small"})
    assert answer["similar_images"] == []
    assert "this one has no structure" in answer["estimate"]["reason"]


def test_the_levels_of_a_path_are_listed_finest_first_and_ever_more_probable(
    tower: Service,
) -> None:
    answer = ask(tower, 0, "tower", certainty=0.01)
    estimate = answer["estimate"]
    levels = [level["place"] for level in estimate["levels"]]
    assert levels == ["tower/7/lift", "tower/7", "tower", None]
    assert [level["whole_map"] for level in estimate["levels"]] == [False] * 3 + [True]
    probabilities = [level["probability"] for level in estimate["levels"]]
    assert probabilities == sorted(probabilities)
    assert estimate["calibration_source"] == "prior", "20 photos leave the coefficients near it"
    assert (estimate["certainty"], estimate["answer_level"]) == (0.01, 0)
    assert 0 <= estimate["not_in_map_probability"] <= 1
    assert (estimate["radius_68_m"], estimate["radius_95_m"]) == (None, None)
    assert estimate["place"] == "tower/7/lift"
    assert answer["similar_images"][0]["match_probability"] == probabilities[0]
    (entry,) = tower.json("GET", "/searches", params={"map": "tower"})["searches"]
    for field in ("in_map", "answer_level", "not_in_map_probability"):
        assert entry[field] == estimate[field]
    assert ask(tower, 0, "tower")["estimate"]["certainty"] == 0.95
    assert [level["place"] for level in ask(tower, 5, "tower")["estimate"]["levels"]] == ["a", None]
    assert ask(tower, 0, "tower", certainty=1)["estimate"]["answer_level"] is None


def test_queries_that_look_less_like_the_map_than_those_of_its_evaluation_are_new_to_it(
    tower: Service,
) -> None:
    fit(tower, "tower", best_scores=[1.0] * 101)
    asked = [ask(tower, number, "tower")["estimate"]["new_to_map"] for number in range(10, 50)]
    assert asked == [False] * 30 + [True] * 10


def test_the_maps_share_of_queries_from_elsewhere_counts_unless_the_request_names_one(
    tower: Service,
) -> None:
    assert tower.json("GET", "/maps/tower")["elsewhere"] == 0.33
    assert tower.json("PATCH", "/maps/tower", json={"elsewhere": 0.1})["elsewhere"] == 0.1
    for share, params in ((0.1, {}), (0.5, {"elsewhere": 0.5})):
        estimate = ask(tower, 0, "tower", **params)["estimate"]
        assert (estimate["elsewhere"], estimate["not_in_map_probability"]) == (share, share)
    problem(tower("PATCH", "/maps/tower", json={"elsewhere": 1}), 422, "invalid_field")


def test_a_level_filters_photos_below_it_and_an_exact_label_only_its_own(tower: Service) -> None:
    def found(**params: Any) -> set[str]:
        images = tower.json("GET", "/search", params={"map": "tower", **params})["images"]
        similar = ask(tower, 0, "tower", **params)["similar_images"]
        places = {image["place"] for image in images}
        assert {image["place"] for image in similar} == places
        return places

    assert found(place_under="tower/7") == {"tower/7/lift", "tower/7/hall"}
    assert found(place_under="tower/7/") == {"tower/7/lift", "tower/7/hall"}
    assert found(place_under="tower") == set(PATHS) - {"a"}
    assert found(place_under="TOWER") == set()
    assert found(place="tower") == {"tower"}
    for level in ("", "/", " / "):
        answer = tower("GET", "/search", params={"map": "tower", "place_under": level})
        problem(answer, 422, "invalid_field")


def test_the_map_setting_turns_labels_into_paths_and_back(service: Service) -> None:
    for number, place in enumerate(PATHS):
        service.upload(photo_bytes(number), place=place)
    service.drain()
    fit(service)
    for setting, are_paths in ((None, False), ("auto", True), (False, False), (True, True)):
        if setting is not None:
            body = {"place_labels_are_paths": setting}
            changed = service.json("PATCH", "/maps/default", json=body)
            assert changed["place_labels_are_paths"] is are_paths
            assert changed["place_labels_are_automatic"] is (setting == "auto")
        assert len(ask(service, 0)["estimate"]["levels"]) == (4 if are_paths else 2)


def test_circles_are_the_levels_of_coordinates(service: Service) -> None:
    service.upload(photo_bytes(0), latitude=45.0, longitude=7.0, place="here")
    service.upload(photo_bytes(1), latitude=46.0, longitude=7.0)
    service.drain()
    fit(service, extent={"diameter_m": 2000})
    estimate = ask(service, 0)["estimate"]
    assert [level["radius_m"] for level in estimate["levels"]] == [25, 100, 500, 2000]
    assert {(level["latitude"], level["longitude"]) for level in estimate["levels"]} == {
        (45.0, 7.0)
    }


def test_a_photo_without_a_location_has_no_levels(service: Service) -> None:
    service.indexed(0)
    fit(service)
    answer = ask(service, 0)
    assert answer["estimate"]["levels"] == []
    assert answer["estimate"]["calibration_source"] is None
    assert answer["similar_images"][0]["match_probability"] is None


def test_a_map_says_whether_its_estimates_are_measured(service: Service) -> None:
    def measurement() -> str:
        described = service.json("GET", "/maps/default")
        assert described["located"] == located
        return str(described["measurement"])

    located = 0
    assert measurement() == "too_few_photos"
    located = len(service.indexed(*range(19), place="hall"))
    service.indexed(30)  # nobody knows where
    assert measurement() == "too_few_photos"
    located += len(service.indexed(19, place="hall"))
    assert measurement() == "due"
    started = service.json("POST", "/evaluations", 202, json={})
    assert measurement() == "running"
    service.json("POST", f"/jobs/{started['job_id']}/cancel")
    assert measurement() == "not_measured"
    fit(service)
    assert measurement() == "measured"


def test_a_certainty_is_above_zero_and_at_most_one(service: Service) -> None:
    for certainty in ("0", "1.01", "nan"):
        files = {"file": ("query.jpg", photo_bytes(0))}
        answer = service("POST", "/similarity", params={"certainty": certainty}, files=files)
        problem(answer, 422, "invalid_field")


def test_the_neighbours_of_a_best_photo_are_searched_once_in_an_unchanged_map(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.indexed(0, 1, place="hall")
    real = service.search.search
    missing: tuple[str, ...] = ("chunks/a/b.npy",)
    requests: list[SearchRequest] = []

    def search(request: SearchRequest) -> SearchResponse:
        requests.append(request)
        return real(request).model_copy(update={"missing": missing})

    def searches() -> int:
        requests.clear()
        ask(service, 0)
        return len(requests)

    monkeypatch.setattr(service.search, "search", search)
    assert [searches(), searches()] == [2, 2], "a ranking that lacks a chunk is not cached"
    missing = ()
    assert [searches(), searches()] == [2, 1]
    service.indexed(2, place="hall")
    assert [searches(), searches()] == [2, 1], "the map has changed"
