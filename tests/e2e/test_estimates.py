"""From similar photos to a place: what an answer says of it, before and after an evaluation."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from tests.support.photos import photo_bytes
from tests.support.problems import got
from tests.support.server import ServerProcess

SETTINGS = {"auto_evaluate_photos": 0}
ENOUGH = 60  # to tell one in twenty, and more than an estimate looks at
ASKED = range(0, ENOUGH, 9)
fresh = itertools.count(9000)


def re_encoded(number: int) -> bytes:
    """The photo `number` with other bytes, and as alike as the tiny extractor can bear."""
    return photo_bytes(number, quality=50)


def fill(server: ServerProcess, name: str, numbers: list[int], *about: dict[str, Any]) -> None:
    """A new map with these photos, `about` says what of each; all can be found."""
    got(server.client.post("/api/v1/maps", json={"name": name}), 201)
    put(server, name, [(photo_bytes(n), fields) for n, fields in zip(numbers, about, strict=True)])


def put(server: ServerProcess, name: str, photos: list[tuple[bytes, dict[str, Any]]]) -> None:
    """Upload photos with their metadata, and wait until all can be found."""
    uploads = [server.upload(data, map_name=name, **fields) for data, fields in photos]
    for upload in uploads:
        job = server.finished(got(upload, 202)["job_id"], map=name)
        assert job["state"] == "succeeded", job


def ask(server: ServerProcess, name: str, data: bytes, **params: Any) -> dict[str, Any]:
    answer: dict[str, Any] = got(server.ask(data, map=name, **params))
    assert answer["estimate"]["reason"]
    assert answer["total_similar"] == len(answer["similar_images"])
    return answer


def evaluate(server: ServerProcess, name: str) -> dict[str, Any]:
    started = got(server.client.post("/api/v1/evaluations", params={"map": name}), 202)
    job = server.finished(started["job_id"], map=name)
    assert job["state"] == "succeeded", job
    return job


@pytest.fixture(scope="module")
def streets(server: ServerProcess) -> list[int]:
    """The numbers of ENOUGH photos in the map `streets`, each a degree from the next."""
    numbers = [next(fresh) for _ in range(ENOUGH)]
    fill(server, "streets", numbers, *({"latitude": n, "longitude": 7} for n in range(ENOUGH)))
    return numbers


def test_an_evaluation_lets_answers_say_whether_the_place_is_in_the_map(
    server: ServerProcess, streets: list[int]
) -> None:
    before = ask(server, "streets", re_encoded(streets[3]))["estimate"]
    assert before["in_map"] is None
    assert "is not measured yet" in before["reason"]
    assert got(server.client.get("/api/v1/maps/streets"))["measurement"] == "not_measured"
    assert (before["confidence"], before["calibration_source"]) == (None, None)
    assert (before["latitude"], before["longitude"]) == (pytest.approx(3), pytest.approx(7))

    job = evaluate(server, "streets")
    # Each photo is searched, and matched with those that it finds.
    assert job["progress"] == {"done": 2 * ENOUGH, "total": 2 * ENOUGH, "failed": 0}
    (body,) = got(server.client.get("/api/v1/evaluations", params={"map": "streets"}))[
        "evaluations"
    ]
    assert not body["automatic"]
    assert body["searchable"] == ENOUGH
    assert job["result"] == {
        "evaluation_id": body["evaluation_id"],
        "generation_id": body["generation_id"],
        **body["figures"],
    }
    assert body["figures"]["leave_one_out"]["without_positive"] == ENOUGH

    # Photos that are alone at their place do not show what another photo of it scores: the prior
    # that the caller states decides.
    copies = [
        ask(server, "streets", re_encoded(streets[n]), elsewhere=0.001)["estimate"] for n in ASKED
    ]
    accepted = [pair for pair in zip(ASKED, copies, strict=True) if pair[1]["in_map"]]
    assert accepted
    for n, estimate in accepted:
        assert (estimate["latitude"], estimate["longitude"]) == (
            pytest.approx(n, abs=1e-6),
            pytest.approx(7),
        )
        level = estimate["levels"][estimate["answer_level"]]
        assert estimate["headline"].startswith("In this map" if level["whole_map"] else "Here")
        assert (estimate["radius_m"], estimate["place"]) == (level["radius_m"], None)
        assert estimate["confidence"] == level["probability"]
    outside = [photo_bytes(next(fresh)) for _ in range(8)]
    estimates_outside = [
        ask(server, "streets", photo, elsewhere=0.9)["estimate"] for photo in outside
    ]
    refused = [
        (photo, estimate)
        for photo, estimate in zip(outside, estimates_outside, strict=True)
        if estimate["in_map"] is False
    ]
    assert len(refused) >= 5
    for _, estimate in refused:
        assert (estimate["latitude"], estimate["place"], estimate["radius_m"]) == (None,) * 3
        assert estimate["headline"].startswith("Probably not in this map")
    filtered = {"near": "3,7,1", "history": False, "elsewhere": 0.9}
    narrow = ask(server, "streets", refused[0][0], **filtered)["estimate"]
    assert narrow["in_map"] is False, "however narrow the filter"
    assert got(server.client.get("/api/v1/maps/streets"))["measurement"] == "measured"
    ask(server, "streets", re_encoded(streets[3]), history=False)
    history = got(server.client.get("/api/v1/searches", params={"map": "streets", "limit": 100}))[
        "searches"
    ]
    assert [(search["in_map"], search["has_place"]) for search in history][::-1] == [
        (estimate["in_map"], estimate["has_place"])
        for estimate in [before, *copies, *estimates_outside]
    ]


def test_an_estimate_uses_the_photos_with_a_place_and_counts_the_others(
    server: ServerProcess,
) -> None:
    """Before each photo with coordinates lies one of the same view without; another is alone."""
    numbers = [next(fresh) for _ in range(ENOUGH)]
    fill(server, "mixed", numbers, *({"latitude": n, "longitude": 7} for n in range(ENOUGH)))
    put(server, "mixed", [(photo_bytes(number, quality=51), {}) for number in numbers])
    there = got(server.client.get("/api/v1/maps/mixed"))
    assert (there["searchable"], there["located"]) == (2 * ENOUGH, ENOUGH)
    evaluate(server, "mixed")

    answers = [
        ask(server, "mixed", re_encoded(numbers[n]), top_k=2, elsewhere=0.001) for n in ASKED
    ]
    accepted = [
        (n, answer)
        for n, answer in zip(ASKED, answers, strict=True)
        if answer["estimate"]["in_map"]
    ]
    assert accepted
    for n, answer in accepted:
        assert answer["similar_images"][0]["latitude"] is None
        assert answer["matches_without_place"] == 1
        assert answer["estimate"]["latitude"] == pytest.approx(n, abs=1e-6)
        assert [m["match_probability"] is None for m in answer["similar_images"]] == [
            m["latitude"] is None for m in answer["similar_images"]
        ]

    unknown = next(fresh)
    put(server, "mixed", [(photo_bytes(unknown), {})])
    for top_k in (1, 10):
        answer = ask(server, "mixed", re_encoded(unknown), top_k=top_k)
        assert answer["estimate"]["headline"].startswith("The photos that look like it have no")


def test_a_filter_that_nothing_passes_gives_no_place_and_says_so(
    server: ServerProcess, streets: list[int]
) -> None:
    answer = ask(server, "streets", re_encoded(streets[0]), near="-80,7,1000")
    assert answer["similar_images"] == []
    assert answer["estimate"]["latitude"] is None
    assert "matches the filter" in answer["estimate"]["reason"]
    narrowed = ask(server, "streets", re_encoded(streets[0]), box="4.5,6,6.5,8")
    assert sorted(found["latitude"] for found in narrowed["similar_images"]) == [5, 6]


def test_more_photos_than_an_estimate_looks_at_are_answered(
    server: ServerProcess, streets: list[int]
) -> None:
    everything = ask(server, "streets", re_encoded(streets[0]), top_k=100)
    scores = [found["similarity_score"] for found in everything["similar_images"]]
    assert len(scores) == ENOUGH
    assert scores == sorted(scores, reverse=True)
    for top_k in (1, 50, 51):
        answer = ask(server, "streets", re_encoded(streets[0]), top_k=top_k)
        shown = [found["image_id"] for found in answer["similar_images"]]
        assert shown == [found["image_id"] for found in everything["similar_images"]][:top_k]
    for rank in (5, 55):
        bound = (scores[rank - 1] + scores[rank]) / 2
        answer = ask(server, "streets", re_encoded(streets[0]), top_k=100, min_score=bound)
        assert answer["total_similar"] == rank
    fill(server, "unplaced", [next(fresh)], {})
    none = ask(server, "unplaced", photo_bytes(next(fresh)), min_score=1)
    assert none["similar_images"] == []
    assert "look like it have no coordinates" in none["estimate"]["reason"]
