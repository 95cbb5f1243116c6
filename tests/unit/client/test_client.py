"""The client: answers as they are, refusals as the errors that the server raised."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from uuid import UUID

import pytest

import placewise
from placewise.client import Client
from shared.errors import (
    Conflict,
    InvalidRequest,
    NotFound,
    PlacewiseError,
    StorageFull,
    TooManyRequests,
    Unavailable,
)
from tests.support.api_responses import JOB, PHOTO_ID, SIMILAR, STARTED, STATS, UPLOADED
from tests.support.fake_server import FakeServer


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client(server.url, patience_seconds=0) as made:
        yield made


ERRORS = [each for each in vars(placewise).values() if inspect.isclass(each)]


@pytest.mark.parametrize("kind", [each for each in ERRORS if issubclass(each, PlacewiseError)])
def test_problem_documents_are_raised_as_typed_errors(
    server: FakeServer, client: Client, kind: type[PlacewiseError]
) -> None:
    problem = kind("some_code", "Some detail.", file_id="abc").as_problem()
    server.will_answer(kind.status, {**problem, "instance": "/api/v1/uploads/abc"})
    with pytest.raises(PlacewiseError) as caught:
        client.photo("abc")
    assert type(caught.value) is kind
    assert (caught.value.code, caught.value.detail) == ("some_code", "Some detail.")
    assert caught.value.extra == {"file_id": "abc"}


@pytest.mark.parametrize("body", [b"<html>Bad Gateway</html>", b"", b"null", b"{}"])
def test_other_error_responses_are_raised_with_their_status(
    server: FakeServer, client: Client, body: bytes
) -> None:
    server.will_answer(502, body)
    with pytest.raises(PlacewiseError) as caught:
        client.stats()
    assert caught.value.code == "bad_answer"
    assert "HTTP 502" in caught.value.detail


def test_upload_sends_the_file_and_only_the_fields_that_are_given(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    photo = tmp_path / "street.jpg"
    photo.write_bytes(b"the photo's bytes")
    server.will_answer(202, UPLOADED)
    assert client.upload(photo, latitude=45.5, place=None).file_id == UUID(PHOTO_ID)
    server.will_answer(202, UPLOADED)
    client.upload(photo, "Piazza Castello.jpg", tags=["night", "wet road"], metadata={"lens": None})
    assert b'filename="Piazza Castello.jpg"' in server.requests[1][2]
    method, path, body = server.requests[0]
    assert (method, path) == ("POST", "/api/v1/upload")
    assert b'filename="street.jpg"' in body
    assert b"the photo's bytes" in body
    assert b"45.5" in body
    assert b"place" not in body
    assert b"\r\nnight,wet road\r\n" in server.requests[1][2]
    assert b'\r\n{"lens": null}\r\n' in server.requests[1][2]
    server.will_answer(202, UPLOADED)
    with photo.open("rb") as opened:
        client.upload(opened)
    assert b'filename="street.jpg"' in server.requests[2][2]
    with pytest.raises(TypeError, match="a path, bytes or an open file, not object"):
        client.upload(object())  # type: ignore[arg-type]


def test_key_that_no_header_can_carry_is_refused(server: FakeServer) -> None:
    for key in ("schlüssel", "two\nlines"):
        with pytest.raises(InvalidRequest) as caught:
            Client(server.url, key=key)
        assert caught.value.code == "bad_key"
        assert key not in caught.value.detail


def test_proxies_of_the_environment_are_not_used_for_this_machine(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ALL_PROXY", "http://127.0.0.1:1")
    server.will_answer(200, STATS)
    with Client(server.url, patience_seconds=0) as client:
        assert client.stats()


@pytest.mark.parametrize(
    "url", ["host:8", "http://", "http://[::1", "http://a:1:2", "http://a/?b=c"]
)
def test_address_that_is_no_url_of_a_server_is_refused(url: str) -> None:
    with pytest.raises(InvalidRequest, match="not a valid URL"):
        Client(url)


def test_file_that_cannot_be_read_is_an_error_before_anything_is_sent(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    with pytest.raises(InvalidRequest) as caught:
        client.upload(tmp_path / "missing.jpg")
    assert caught.value.code == "unreadable_file"
    assert server.requests == []


def test_map_is_named_in_every_call(server: FakeServer) -> None:
    server.will_answer(200, STATS)
    server.will_answer(200, {"images": [], "next_cursor": None})
    with Client(server.url + "/api/v1/", map="lab", patience_seconds=0) as client:
        client.stats()
        assert list(client.photos(filename="a b")) == []
    assert server.requests[0][1] == "/api/v1/database/stats?map=lab"
    assert "map=lab" in server.requests[1][1]
    assert "filename=a" in server.requests[1][1]


def test_query_that_takes_longer_is_fetched_when_its_job_has_ended(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    photo = tmp_path / "where.jpg"
    photo.write_bytes(b"bytes")
    server.will_answer(202, {"job_id": "abc", "result_url": "/api/v1/queries/abc/similar"})
    server.will_answer(200, JOB)
    server.will_answer(200, SIMILAR)
    assert client.similar(photo, wait_seconds=7).as_json() == SIMILAR
    assert server.headers[0]["Prefer"] == "wait=7"
    assert [request[1].split("?")[0] for request in server.requests][1:] == [
        "/api/v1/jobs/abc",
        "/api/v1/queries/abc/similar",
    ]


# --- patience --------------------------------------------------------------------------------


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The waits, which take no time: the clock is moved instead."""
    waits: list[float] = []
    clock = [1000.0]

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        clock[0] += seconds

    # The client's alone: threads that other tests have left go by the real one.
    own = SimpleNamespace(sleep=sleep, monotonic=lambda: clock[0])
    monkeypatch.setattr("placewise.async_transport.time", own)
    monkeypatch.setattr("placewise.client.time", own)
    monkeypatch.setattr("placewise.protocol.random", SimpleNamespace(uniform=lambda low, _: low))
    return waits


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "street.jpg"
    path.write_bytes(b"the photo's bytes" * 1000)
    return path


def refuse(server: FakeServer, error: PlacewiseError, **headers: str) -> None:
    server.will_answer(error.status, error.as_problem(), **headers)


AWAY = Unavailable("search_behind", "Away.")


def test_a_repeated_upload_sends_the_same_key_and_all_its_bytes_again(
    server: FakeServer, photo: Path, slept: list[float]
) -> None:
    refuse(server, AWAY)
    refuse(server, StorageFull("disk_full", "Full.", retry_after_seconds=7))
    server.will_answer(202, UPLOADED)
    with Client(server.url, patience_seconds=60) as client:
        assert client.upload(photo).as_json() == UPLOADED
    assert [photo.read_bytes() in body for _, _, body in server.requests] == [True] * 3
    keys = [headers.get("Idempotency-Key") for headers in server.headers]
    assert keys[0] is not None
    assert len(set(keys)) == 1
    assert slept == [0.5, 7]


def test_only_creating_calls_send_an_idempotency_key_and_each_its_own(
    server: FakeServer, slept: list[float]
) -> None:
    deleted = {"success": True, "message": "", "deleted_file_id": PHOTO_ID}
    for answer in (STARTED, STARTED, STATS, deleted):
        server.will_answer(200, answer)
    with Client(server.url, patience_seconds=60) as client:
        client.evaluate()
        client.evaluate()
        client.stats()
        client.delete_photo("abc")
    keys = [headers.get("Idempotency-Key") for headers in server.headers]
    assert keys[0] != keys[1]
    assert keys[2:] == [None, None]


def test_a_client_without_retries_sends_no_idempotency_key(
    server: FakeServer, client: Client, photo: Path, slept: list[float]
) -> None:
    for error in (AWAY, TooManyRequests("queue_full", "Full.", retry_after_seconds=3)):
        refuse(server, error)
        with pytest.raises(type(error)):
            client.upload(photo)
    assert len(server.requests) == 2
    assert [headers.get("Idempotency-Key") for headers in server.headers] == [None, None]
    assert slept == []


def test_retries_end_with_the_last_error(server: FakeServer, slept: list[float]) -> None:
    for _ in range(5):
        refuse(server, AWAY)
    with Client(server.url, patience_seconds=2) as client, pytest.raises(Unavailable) as caught:
        client.stats()
    assert caught.value.code == "search_behind"
    assert slept == [0.5, 1, 2]


def test_retry_after_is_obeyed_however_long(server: FakeServer, slept: list[float]) -> None:
    seen: list[tuple[str, float]] = []
    for seconds in (30, 60, 4000):
        refuse(server, TooManyRequests("queue_full", "Full.", retry_after_seconds=seconds))
    server.will_answer(200, STATS)
    with Client(server.url, patience_seconds=0) as client:
        patient = client.with_patience(1, lambda error, seconds: seen.append((error.code, seconds)))
        assert patient.stats().as_json() == STATS
    assert slept == [30, 60, 300]
    assert seen == [("queue_full", seconds) for seconds in slept]


def test_a_proxys_retry_after_is_obeyed_too(server: FakeServer, slept: list[float]) -> None:
    refuse(server, AWAY, **{"Retry-After": "9"})
    server.will_answer(200, STATS)
    with Client(server.url, patience_seconds=60) as client:
        client.stats()
    assert slept == [9]


def test_permanent_errors_are_not_retried(server: FakeServer, slept: list[float]) -> None:
    refuse(server, NotFound("photo_not_found", "None."))
    refuse(server, Conflict("photo_differs", "Other."))
    server.will_answer(500, b"broken")
    with Client(server.url, patience_seconds=60) as client:
        for number in (1, 2, 3):
            with pytest.raises(PlacewiseError):
                client.stats()
            assert len(server.requests) == number
    assert slept == []
