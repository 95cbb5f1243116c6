"""Model changes: a map gets a vocabulary, and another one, while search goes on."""

from __future__ import annotations

import io
import itertools
import threading
import time
from dataclasses import dataclass
from typing import Any

import httpx2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.photos import photo_bytes
from tests.support.problems import got, problem
from tests.support.server import ServerProcess

# An extractor without a vocabulary of its own, in a map with too few photos to fit one by itself.
SETTINGS = {"extractor": "test-tiny-vlad"}
PHOTOS = 12
WIDTH = 16  # of the tiny extractor's local features
VOCABULARIES = "/api/v1/vocabularies"
GENERATIONS = "/api/v1/generations"


def started(answer: httpx2.Response) -> str:
    """The job of an accepted model change."""
    assert answer.status_code == 202, answer.text
    body = answer.json()
    assert set(body) >= {"job_id", "status", "status_url"}
    assert body["status_url"] == f"/api/v1/jobs/{body['job_id']}" == answer.headers["location"]
    assert int(answer.headers["retry-after"]) > 0
    job_id: str = body["job_id"]
    return job_id


def npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def centres(seed: int) -> NDArray[np.float32]:
    return np.random.default_rng(seed).standard_normal((8, WIDTH)).astype(np.float32)


def post_import(server: ServerProcess, data: bytes) -> httpx2.Response:
    return server.client.post(f"{VOCABULARIES}/import", files={"file": ("c.npy", data)})


def done(server: ServerProcess, answer: httpx2.Response) -> dict[str, Any]:
    """The result of a model change that succeeded."""
    job = server.finished(started(answer))
    assert job["state"] == "succeeded", job
    result: dict[str, Any] = job["result"]
    return result


def active(server: ServerProcess) -> dict[str, Any]:
    (found,) = (g for g in got(server.client.get(GENERATIONS)) if g["state"] == "active")
    generation: dict[str, Any] = found
    return generation


def vocabulary(server: ServerProcess, vocabulary_id: str) -> dict[str, Any]:
    (found,) = (
        v for v in got(server.client.get(VOCABULARIES)) if v["vocabulary_id"] == vocabulary_id
    )
    one: dict[str, Any] = found
    return one


@dataclass(frozen=True, slots=True)
class Before:
    """A map without a vocabulary."""

    fit_of_nothing: httpx2.Response
    photos: list[str]
    stats: dict[str, Any]
    by_new: httpx2.Response
    vocabularies: list[Any]


@pytest.fixture(scope="module")
def before(server: ServerProcess) -> Before:
    """PHOTOS photos are described before the map has a vocabulary."""
    fit_of_nothing = server.client.post(VOCABULARIES, json={})
    uploads = [server.upload(photo_bytes(n), f"{n}.jpg").json() for n in range(PHOTOS)]
    for upload in uploads:
        assert server.finished(upload["job_id"])["state"] == "succeeded"
    return Before(
        fit_of_nothing=fit_of_nothing,
        photos=[upload["file_id"] for upload in uploads],
        stats=got(server.client.get("/api/v1/database/stats")),
        by_new=server.ask(photo_bytes(0)),
        vocabularies=got(server.client.get(VOCABULARIES)),
    )


@pytest.fixture(scope="module")
def fitted(server: ServerProcess, before: Before) -> dict[str, Any]:
    """The result of the first fit."""
    return done(server, server.client.post(VOCABULARIES, json={}))


def test_a_map_answers_before_it_has_a_vocabulary(before: Before) -> None:
    problem(before.fit_of_nothing, 409, "no_photos")
    assert before.stats["searchable_images"] == before.stats["total_images"] == PHOTOS
    assert before.stats["vocabulary"] == "pending"
    assert before.vocabularies == []
    assert got(before.by_new)["similar_images"][0]["image_id"] == before.photos[0]


def test_a_fit_describes_every_photo_again(server: ServerProcess, fitted: dict[str, Any]) -> None:
    assert fitted["photos"] == PHOTOS
    assert fitted["failed"] == 0
    learnt = vocabulary(server, fitted["vocabulary_id"])
    assert learnt["origin"] == "fitted"
    assert learnt["clusters"] == fitted["clusters"] > 1
    assert learnt["dimension"] == WIDTH
    assert learnt["provenance"]["photos"] == PHOTOS
    assert learnt["provenance"]["clusters_asked"] == 8, "the extractor's, as none were named"
    for generation in got(server.client.get(GENERATIONS)):
        if generation["generation_id"] == fitted["generation_id"]:
            assert generation["vocabulary_id"] == fitted["vocabulary_id"]
            assert generation["dimension"] == WIDTH * fitted["clusters"]
            assert generation["extractor"] == "test-tiny-vlad"


def test_answers_say_whose_vocabulary_they_were_made_with(
    server: ServerProcess, before: Before, fitted: dict[str, Any]
) -> None:
    imported = done(server, post_import(server, npy(centres(1))))
    assert (imported["clusters"], imported["photos"]) == (8, active(server)["photos"])
    assert vocabulary(server, imported["vocabulary_id"])["origin"] == "imported"
    assert vocabulary(server, imported["vocabulary_id"])["provenance"]["imported_from"] == "c.npy"
    for body in (got(server.ask(photo_bytes(3))), got(server.similar(before.photos[3]))):
        assert body["vocabulary"] == "foreign"
        assert body["generation_id"] == imported["generation_id"]
    assert got(server.client.get("/api/v1/database/stats"))["vocabulary"] == "foreign"

    own = done(server, server.client.post(VOCABULARIES, json={"clusters": 4, "seed": 7}))
    assert own["clusters"] == 4
    for body in (got(server.ask(photo_bytes(3))), got(server.similar(before.photos[3]))):
        assert body["vocabulary"] == "provisional"
        assert body["generation_id"] == own["generation_id"]
    assert got(server.ask(photo_bytes(3)))["similar_images"][0]["image_id"] == before.photos[3]
    stats = got(server.client.get("/api/v1/database/stats"))
    assert (stats["vocabulary"], stats["feature_dimension"]) == ("provisional", 4 * WIDTH)
    assert vocabulary(server, own["vocabulary_id"])["provenance"]["seed"] == 7


@pytest.mark.usefixtures("fitted")
def test_search_never_fails_while_the_model_changes(server: ServerProcess, before: Before) -> None:
    old = active(server)["generation_id"]
    answers: list[httpx2.Response] = []
    enough = threading.Event()

    def ask_all_the_time() -> None:
        for turn in itertools.count():
            if enough.is_set():
                return
            answers.append(server.similar(before.photos[turn % PHOTOS]))
            answers.append(server.ask(photo_bytes(turn % PHOTOS)))

    asking = threading.Thread(target=ask_all_the_time)

    def wait_for_four_more() -> None:
        reached = len(answers)
        while len(answers) < reached + 4 and asking.is_alive():
            time.sleep(0.01)

    asking.start()
    try:
        wait_for_four_more()
        new = done(server, server.client.post(VOCABULARIES, json={"clusters": 3}))
        wait_for_four_more()
    finally:
        enough.set()
        asking.join()
    assert {answer.status_code for answer in answers} == {200}, [a.text for a in answers]
    used = [answer.json()["generation_id"] for answer in answers]
    assert set(used) == {old, new["generation_id"]}
    assert (used[0], used[-1]) == (old, new["generation_id"])
    for answer in answers:
        assert answer.json()["missing"] == []
        assert len(answer.json()["similar_images"]) == 10
