"""The typed client: one implementation for both ways of waiting, answers as the API describes."""

from __future__ import annotations

import asyncio
import inspect
import json
from pathlib import Path
from uuid import UUID

import pytest

import placewise
from placewise import answers
from tests.support.api_responses import JOB, PHOTO, SIMILAR, STARTED, UPLOADED
from tests.support.fake_server import FakeServer


def test_synchronous_client_has_every_call_of_the_asynchronous_one_with_its_parameters() -> None:
    """`close` is called `aclose` there; the other calls have the same name."""
    both = [
        {name: value for name, value in inspect.getmembers(form) if not name.startswith("_")}
        for form in (placewise.Client, placewise.AsyncClient)
    ]
    assert inspect.getdoc(both[0].pop("close")) == inspect.getdoc(both[1].pop("aclose"))
    assert both[0].keys() == both[1].keys()
    for name, call in both[0].items():
        assert inspect.signature(call) == inspect.signature(both[1][name])
        assert inspect.getdoc(call) == inspect.getdoc(both[1][name])


def test_answers_are_typed_and_keep_what_a_newer_server_adds(server: FakeServer) -> None:
    newer = PHOTO | {"job_id": None, "media_type": "image/jpeg", "sha256": "a", "searchable": True}
    server.will_answer(200, {**newer, "storeys": 5, "role": "archive"})
    with placewise.connect(server.url) as places:
        photo = places.photo("abc")
    assert photo.image_id == UUID(str(PHOTO["image_id"]))
    assert photo.upload_time.utcoffset() is not None
    assert photo.model_extra == {"storeys": 5}
    assert photo.role == "archive"
    assert photo.as_json() == {**newer, "storeys": 5, "role": "archive"}


def test_photos_are_fetched_page_after_page_as_they_are_reached(server: FakeServer) -> None:
    server.will_answer(200, {"images": [PHOTO, PHOTO], "next_cursor": "more"})
    server.will_answer(200, {"images": [PHOTO], "next_cursor": None})
    with placewise.connect(server.url, map="lab") as places:
        found = places.photos(tags=["a", "b"])
        next(found)
        assert len(server.requests) == 1
        assert len(list(found)) == 2
    assert "cursor=more" in server.requests[1][1]
    assert all("map=lab" in path and "tags=a%2Cb" in path for _, path, _ in server.requests)


def test_wait_raises_the_error_of_a_failed_job(server: FakeServer) -> None:
    error = {"code": "undecodable_photo", "detail": "It is cut off.", "status": 422}
    server.will_answer(200, {**JOB, "state": "running"})
    server.will_answer(200, {**JOB, "state": "failed", "error": error})
    seen: list[str] = []
    with (
        placewise.connect(server.url) as places,
        pytest.raises(placewise.Unprocessable) as caught,
    ):
        places.wait(str(JOB["job_id"]), on_progress=lambda job: seen.append(job.state))
    assert (caught.value.code, caught.value.detail) == ("undecodable_photo", "It is cut off.")
    assert seen == ["running", "failed"]


def test_watching_a_job_shows_each_state_and_raises_no_failure(server: FakeServer) -> None:
    server.will_answer(200, {**JOB, "state": "running"})
    server.will_answer(200, {**JOB, "state": "queued", "waiting_for": "disk_space"})
    server.will_answer(200, {**JOB, "state": "cancelled"})
    with placewise.connect(server.url) as places:
        seen = list(places.watch(answers.Started(**STARTED), poll_seconds=2))
    assert [job.state for job in seen] == ["running", "queued", "cancelled"]
    assert "wait=2" in server.requests[0][1]
    with pytest.raises(placewise.Unprocessable) as caught:
        seen[-1].raise_for_failure()
    assert caught.value.code == "job_ended"


def test_keys_are_created_with_the_limits_that_are_given(server: FakeServer) -> None:
    unlimited = dict.fromkeys(("maps", "max_photos"))
    limits = {"requests_per_minute": 60, **unlimited}
    times = {"created_at": JOB["created_at"], "expires_at": None, "last_used_at": None}
    key = {"id": JOB["job_id"], "name": "me", "prefix": "pw_1", "scopes": ["read"], **limits}
    server.will_answer(201, {**key, **times, "revoked_at": None, "key": "pw_1secret"})
    with placewise.connect(server.url) as places:
        created = places.create_key("me", ["read"], days=None, requests_per_minute=60)
    sent = json.loads(server.requests[0][2])
    assert sent == {"name": "me", "scopes": ["read"], "requests_per_minute": 60}
    assert (created.key, created.requests_per_minute) == ("pw_1secret", 60)


def test_a_model_is_sent_with_its_name(server: FakeServer, tmp_path: Path) -> None:
    checkpoint = tmp_path / "best.ckpt"
    checkpoint.write_bytes(b"w" * 300_000)
    server.will_answer(202, STARTED)
    with placewise.connect(server.url) as places:
        places.add_model(checkpoint, "lab", licence="MIT")
    method, path, body = server.requests[0]
    assert (method, path) == ("POST", "/api/v1/models")
    assert b'name="licence"' in body
    assert b'name="note"' not in body
    assert checkpoint.read_bytes() in body


def test_answers_serialise_to_the_json_that_the_server_sent(server: FakeServer) -> None:
    sent = {**SIMILAR, "similar_images": [{**PHOTO, "similarity_score": 1.0}], "newer": [1]}
    server.will_answer(200, sent)
    with placewise.connect(server.url) as places:
        assert places.similar(UUID(str(PHOTO["image_id"]))).as_json() == sent


def test_wait_ends_at_its_timeout(server: FakeServer) -> None:
    server.will_answer(200, {**JOB, "state": "running"})
    with placewise.connect(server.url) as places, pytest.raises(placewise.Unavailable) as caught:
        places.wait(str(JOB["job_id"]), timeout_seconds=0)
    assert caught.value.code == "job_unfinished"


def test_asynchronous_client_uploads_waits_and_lists(server: FakeServer, tmp_path: Path) -> None:
    path = tmp_path / "street.jpg"
    path.write_bytes(b"the photo's bytes" * 100_000)
    server.will_answer(202, UPLOADED)
    server.will_answer(200, JOB)
    server.will_answer(200, {"images": [PHOTO], "next_cursor": None})

    async def use() -> list[answers.Photo]:
        async with placewise.connect_async(server.url, key="secret") as places:
            job = await places.wait(await places.upload(path, latitude=45.5))
            assert job.finished
            return [photo async for photo in places.photos()]

    assert [photo.latitude for photo in asyncio.run(use())] == [45.5]
    assert path.read_bytes() in server.requests[0][2]
    assert {headers.get("Authorization") for headers in server.headers} == {"Bearer secret"}


def test_package_says_that_it_is_typed() -> None:
    assert Path(placewise.__file__).with_name("py.typed").is_file()
