"""Several maps in one server: made and deleted, over HTTP and by command, each for itself."""

from __future__ import annotations

import base64
import itertools
import re
from pathlib import Path
from typing import Any
from uuid import uuid4

from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import field_refused, got, problem
from tests.support.server import CommandLine, ServerProcess

SETTINGS = {"auto_evaluate_photos": 0}
MAPS = "/api/v1/maps"
POSE = {"camera": 0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}
PHOTO = base64.b64encode(photo_bytes(1)).decode()
BODIES: dict[str, Any] = {
    "geopose": {"sensorReadings": {"cameraReadings": [{"imageBytes": PHOTO}]}},
    "places": {"photos": [{"file_id": str(uuid4()), "latitude": 45.0, "longitude": 7.0}]},
    "positions": {"photos": []},
    "import": {
        "cameras": [{"model": "SIMPLE_PINHOLE", "width": 4, "height": 3, "params": [4, 2, 1.5]}],
        "photos": [{"name": name, **POSE} for name in "abc"],
    },
}
"""What calls with JSON need, by the end of their paths."""
fresh = itertools.count(7000)
names = (f"town-{number}" for number in itertools.count())


def make(server: ServerProcess, **params: Any) -> str:
    """A new map; its name."""
    name = next(names)
    made = got(server.client.post(MAPS, json={"name": name, **params}), 201)
    assert made["name"] == name
    return name


def store(server: ServerProcess, name: str, *numbers: int, **fields: Any) -> list[str]:
    """Photos that can be found in the map; their ids."""
    found = []
    for number in numbers:
        answer = server.client.post(
            "/api/v1/upload",
            params={"map": name},
            files={"file": ("photo.jpg", photo_bytes(number))},
            data={key: str(value) for key, value in fields.items()},
            headers={"Prefer": "wait=30"},
        )
        found.append(got(answer, 201)["file_id"])
    return found


# --- made, listed, refused -------------------------------------------------------------------


def test_a_map_is_made_listed_and_looked_at(server: ServerProcess) -> None:
    name = make(server, extractor="test-tiny-vlad")
    listed = got(server.client.get(MAPS))
    assert [map_["name"] for map_ in listed] == sorted(map_["name"] for map_ in listed)
    assert {"default", name} <= {map_["name"] for map_ in listed}
    (found,) = (map_ for map_ in listed if map_["name"] == name)
    alone = got(server.client.get(f"{MAPS}/{name}"))
    assert found | {"counted_at": None} == alone | {"counted_at": None}
    assert found["extractor"] == "test-tiny-vlad"
    assert (found["photos"], found["searchable"], found["labelled_queries"]) == (0, 0, 0)
    assert (found["generation_id"], found["vocabulary"]) == (None, None)


def test_a_name_has_1_to_100_letters_digits_or_inner_punctuation(server: ServerProcess) -> None:
    for name in ("", "a b", "a/b", ".a", "-a", "_a", "ä", "a\n", "a" * 101, None):
        field_refused(server.client.post(MAPS, json={"name": name}), "name")
    for name in ("a" * 100, "0", "A.b_c-d", "maps", "null"):
        got(server.client.post(MAPS, json={"name": name}), 201)
        assert got(server.client.get(f"{MAPS}/{name}"))["name"] == name
        got(server.client.delete(f"{MAPS}/{name}"))
    name = make(server)
    problem(server.client.post(MAPS, json={"name": name}), 409, "map_exists")
    got(server.client.post(MAPS, json={"name": name.upper()}), 201)  # case matters


def test_every_call_says_how_to_make_the_map_that_is_missing(server: ServerProcess) -> None:
    api = got(server.client.get("/openapi.json"))
    requests = []
    for path, calls in api["paths"].items():
        for method, call in calls.items():
            if not any(p["name"] == "map" for p in call.get("parameters", ())):
                continue
            content = call.get("requestBody", {}).get("content", {})
            body: dict[str, Any] = {}
            if "multipart/form-data" in content:
                body = {"files": {"file": ("photo.jpg", photo_bytes(1))}}
                if path.endswith("/models"):
                    body["data"] = {"name": "mine"}
            elif "application/json" in content:
                body = {"json": BODIES.get(path.rpartition("/")[2], {})}
            here = re.sub(r"{\w+}", lambda _: str(uuid4()), path)
            answer = server.client.request(method, here, params={"map": "nowhere"}, **body)
            detail = problem(answer, 404, "map_not_found")["detail"]
            assert "placewise maps create nowhere" in detail
            assert f"POST {MAPS}" in detail
            requests.append(f"{method} {path}")
    assert len(requests) >= 22, requests
    for method in ("GET", "DELETE"):
        problem(server.client.request(method, f"{MAPS}/nowhere"), 404, "map_not_found")


# --- each for itself -------------------------------------------------------------------------


def test_searches_find_photos_of_their_map_alone(server: ServerProcess) -> None:
    one, other = make(server), make(server)
    numbers = [next(fresh) for _ in range(3)]
    here, there = store(server, one, *numbers), store(server, other, *numbers)
    for name, ids in ((one, here), (other, there)):
        by_new = server.client.post(
            "/api/v1/similarity",
            params={"map": name, "top_k": 100},
            files={"file": ("q.jpg", near_copy(numbers[0]))},
            headers={"Prefer": "wait=30"},
        )
        assert {found["image_id"] for found in got(by_new)["similar_images"]} == set(ids)
        by_stored = server.similar(ids[0], map=name, top_k=100)
        assert {found["image_id"] for found in got(by_stored)["similar_images"]} == set(ids[1:])
        listed = got(server.client.get("/api/v1/search", params={"map": name}))
        assert {found["image_id"] for found in listed["images"]} == set(ids)
        expected = ",".join([*here, *there])
        answer = got(server.similar(ids[0], map=name, ids=expected))
        assert {found["image_id"] for found in answer["similar_images"]} == set(ids[1:])
    got(server.client.delete(f"/api/v1/uploads/{here[0]}", params={"map": one}))
    twin = got(server.client.get(f"/api/v1/uploads/{there[0]}", params={"map": other}))
    assert twin["searchable"], "the same bytes in two maps are two photos"


def test_what_belongs_to_one_map_is_not_found_in_another(server: ServerProcess) -> None:
    one, other = make(server), make(server)
    (here,) = store(server, one, next(fresh))
    job_id = got(server.client.get(f"/api/v1/uploads/{here}", params={"map": one}))["job_id"]
    for method, path in (
        ("GET", f"/uploads/{here}"),
        ("PATCH", f"/uploads/{here}"),
        ("DELETE", f"/uploads/{here}"),
        ("GET", f"/uploads/{here}/image"),
        ("GET", f"/uploads/{here}/thumbnail"),
        ("GET", f"/uploads/{here}/preview"),
        ("POST", f"/similarity/{here}"),
    ):
        fields = {"place": "x"} if method == "PATCH" else None
        answer = server.client.request(method, f"/api/v1{path}", params={"map": other}, json=fields)
        problem(answer, 404, "photo_not_found")
    for method, path in (("GET", ""), ("GET", "/result"), ("POST", "/cancel"), ("POST", "/retry")):
        answer = server.client.request(
            method, f"/api/v1/jobs/{job_id}{path}", params={"map": other}
        )
        problem(answer, 404, "job_not_found")
    photo = got(server.client.get(f"/api/v1/uploads/{here}", params={"map": one}))
    assert (photo["place"], photo["searchable"]) == (None, True)


def test_lists_and_statistics_are_those_of_their_map(server: ServerProcess) -> None:
    one, other = make(server), make(server)
    (here, _) = store(server, one, next(fresh), next(fresh), place="hall")
    store(server, other, next(fresh))
    got(server.similar(here, map=one))
    job_id = got(server.client.post("/api/v1/evaluations", params={"map": one}), 202)["job_id"]
    assert server.finished(job_id, map=one)["state"] == "succeeded"

    def lengths(name: str) -> list[int]:
        return [
            len(got(server.client.get(f"/api/v1/{path}", params={"map": name}))[path])
            for path in ("jobs", "searches", "evaluations")
        ]

    assert lengths(one) == [3, 1, 1]
    assert lengths(other) == [1, 0, 0]
    stats = [
        got(server.client.get("/api/v1/database/stats", params={"map": name}))
        for name in (one, other)
    ]
    assert [s["map"] for s in stats] == [one, other]
    assert [s["total_images"] for s in stats] == [2, 1]
    assert [s["total_searches"] for s in stats] == [1, 0]
    assert [sum(s["jobs"].values()) for s in stats] == [3, 1]


# --- by command ------------------------------------------------------------------------------


def test_maps_are_created_filled_searched_and_deleted_by_command(
    server: ServerProcess, tmp_path: Path
) -> None:
    command = CommandLine(tmp_path, server.home, **SETTINGS)

    def placewise(*arguments: str | Path) -> Any:
        return command(*arguments, "--json").json()

    name = next(names)
    assert placewise("maps", "create", name)["name"] == name
    photos, queries = tmp_path / "photos", tmp_path / "queries"
    numbers = [next(fresh) for _ in range(3)]
    for folder, quality in ((photos, 75), (queries, 50)):
        folder.mkdir()
        for number in numbers:
            (folder / f"{number}.jpg").write_bytes(photo_bytes(number, quality=quality))
        (folder / "places.csv").write_text(
            "filename,place\n" + "".join(f"{n}.jpg,room {n}\n" for n in numbers)
        )
    table = "places.csv"
    placewise("index", photos, "--csv", photos / table, "--map", name)
    placewise("index", queries, "--csv", queries / table, "--map", name, "--role", "query")
    (listed,) = (map_ for map_ in placewise("maps", "list") if map_["name"] == name)
    assert (listed["photos"], listed["searchable"], listed["labelled_queries"]) == (3, 3, 3)
    answer = placewise(
        "query", queries / f"{numbers[1]}.jpg", "--map", name, "--place", f"room {numbers[2]}"
    )
    assert [found["place"] for found in answer["similar_images"]] == [f"room {numbers[2]}"]
    figures = placewise("evaluate", "--map", name)
    assert figures["leave_one_out"]["without_positive"] == 3
    assert figures["labelled_queries"]["queries"] == 3
    assert figures["labelled_queries"]["R@1"] == 1
    assert command("maps", "delete", name).code != 0, "nobody confirmed"
    assert placewise("maps", "delete", name, "--yes")["deleted_map"] == name
    chosen = "test-tiny-vlad:preprocessing=demo1024"
    other = placewise("maps", "create", next(names), "--extractor", chosen)
    assert other["extractor"] == chosen
    command("maps", "create", "not a name", "--json").refusal("invalid_field")
