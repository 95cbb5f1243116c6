"""Which known place is this? Asked with stored photos and with new ones."""

from __future__ import annotations

import itertools
from typing import Any
from uuid import uuid4

import pytest

from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, got, problem
from tests.support.server import ServerProcess

PLACES = 8
SIMILARITY = "/api/v1/similarity"
# Each test that changes the map takes photos of its own.
fresh = itertools.count(1000)


@pytest.fixture(scope="module")
def places(server: ServerProcess) -> list[str]:
    """PLACES photos of known places; their ids. Number 1 is the first."""
    return [
        server.indexed(photo_bytes(n), f"place-{n}.jpg", latitude=40 + n, longitude=7, tags="a,b")
        for n in range(1, PLACES + 1)
    ]


def re_encoded(number: int) -> bytes:
    """The photo `number` with other bytes, and as alike as the tiny extractor can bear."""
    return photo_bytes(number, quality=50)


def ids(body: dict[str, Any]) -> list[str]:
    return [found["image_id"] for found in body["similar_images"]]


def scores(body: dict[str, Any]) -> list[float]:
    return [found["similarity_score"] for found in body["similar_images"]]


def stats(server: ServerProcess) -> Any:
    return got(server.client.get("/api/v1/database/stats"))


def test_a_near_copy_finds_its_place_first(server: ServerProcess, places: list[str]) -> None:
    for number, place in enumerate(places, start=1):
        body = got(server.ask(photo_bytes(number), top_k=3))
        assert ids(body)[0] == place
        best = body["similar_images"][0]
        assert best["original_filename"] == f"place-{number}.jpg"
        assert (best["latitude"], best["longitude"]) == (40 + number, 7)
        assert best["similarity_score"] > 0.9 > scores(body)[1]


def test_a_bad_parameter_is_refused_by_name(server: ServerProcess, places: list[str]) -> None:
    for named, value in (("top_k", "0"), ("top_k", "101"), ("min_score", "1.5")):
        params: dict[str, Any] = {named: value}
        field_refused(server.similar(places[0], **params), named)
        field_refused(server.ask(photo_bytes(1), **params), named)
    files = {"file": ("q.jpg", photo_bytes(1))}
    field_refused(server.client.post(SIMILARITY, files=files, data={"top_k": "3"}), "top_k")


def test_a_query_photo_that_can_not_be_decoded_is_refused(server: ServerProcess) -> None:
    problem(server.ask(photo_bytes(next(fresh))[:-60]), 422, "undecodable_photo")


def test_a_photo_that_is_not_described_yet_says_what_to_wait_for(server: ServerProcess) -> None:
    with server.no_decoding():
        uploaded = server.upload(photo_bytes(next(fresh))).json()
        body = problem(server.similar(uploaded["file_id"]), 409, "not_searchable")
        assert body["job_id"] == uploaded["job_id"]
        assert body["status_url"] == uploaded["status_url"]
        assert body["state"] in ("queued", "running")
        assert uploaded["status_url"] in body["detail"]
    server.finished(uploaded["job_id"])
    got(server.similar(uploaded["file_id"]))


def test_a_photo_that_could_not_be_described_says_why(server: ServerProcess) -> None:
    uploaded = server.upload(photo_bytes(next(fresh))[:-60]).json()
    failed = server.finished(uploaded["job_id"])
    body = problem(server.similar(uploaded["file_id"]), 409, "not_searchable")
    assert (body["job_id"], body["state"]) == (uploaded["job_id"], "failed")
    assert failed["error"]["detail"] in body["detail"]


def test_a_query_without_prefer_wait_is_answered_with_a_job(
    server: ServerProcess, places: list[str]
) -> None:
    files = {"file": ("q.jpg", re_encoded(1))}
    with server.no_decoding():
        answer = server.client.post(SIMILARITY, files=files, params={"top_k": 2, "min_score": 0.5})
        started = answer.json()
        assert answer.status_code == 202
        assert answer.headers["location"] == started["status_url"]
        assert int(answer.headers["retry-after"]) > 0
        assert started["result_url"] == f"/api/v1/jobs/{started['job_id']}/result"
        body = problem(server.client.get(started["result_url"]), 409, "job_unfinished")
        assert body["job_id"] == started["job_id"]
    job = server.finished(started["job_id"])
    assert (job["state"], job["kind"]) == ("succeeded", "describe")
    assert job["result_url"] == started["result_url"]
    body = got(server.client.get(started["result_url"]))
    assert ids(body) == [places[0]], "the query's own top_k and min_score count"
    assert body["query_filename"] == "q.jpg"


def test_a_query_that_takes_longer_than_preferred_becomes_a_job(server: ServerProcess) -> None:
    with server.no_decoding():
        answer = server.ask(photo_bytes(next(fresh)), wait=1)
        assert answer.status_code == 202
        assert answer.headers["preference-applied"] == "wait=1"
    assert server.finished(answer.json()["job_id"])["state"] == "succeeded"
    got(server.client.get(answer.json()["result_url"]))


def test_only_queries_have_results(server: ServerProcess) -> None:
    job_id = server.upload(photo_bytes(1)).json()["job_id"]
    problem(server.client.get(f"/api/v1/jobs/{job_id}/result"), 409, "no_result")


def test_every_search_counts_and_no_query_photo_is_kept(
    server: ServerProcess, places: list[str]
) -> None:
    before = stats(server)
    got(server.similar(places[0]))
    got(server.ask(photo_bytes(next(fresh))))
    problem(server.similar(str(uuid4())), 404, "photo_not_found")
    after = stats(server)
    for figure in ("total_searches", "recent_searches_24h"):
        assert after[figure] == before[figure] + 2
    for figure in ("total_images", "searchable_images"):
        assert after[figure] == before[figure]
    assert after["max_processing_time_ms"] >= after["avg_processing_time_ms"] > 0
