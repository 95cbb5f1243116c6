"""The client: answers as they are, refusals as the errors that the server raised."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from shared.client import Client, retry_while_away
from shared.errors import (
    Conflict,
    Gone,
    InvalidRequest,
    NotFound,
    PlacewiseError,
    TooLarge,
    Unauthorized,
    Unavailable,
    Unprocessable,
    UnsupportedMedia,
)


class FakeServer(HTTPServer):
    """Answers what the test says and remembers what it was asked."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.answers: list[tuple[int, bytes]] = []
        self.asked: list[tuple[str, str, bytes]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def will_answer(self, status: int, body: Any) -> None:
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.answers.append((status, data))


class Handler(BaseHTTPRequestHandler):
    server: FakeServer

    def answer(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.server.asked.append((self.command, self.path, body))
        status, data = self.server.answers.pop(0)
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    do_GET = do_POST = answer  # noqa: N815

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Keep the test's output clean."""


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer() as made:
        thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield made
        made.shutdown()
        thread.join()


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client(server.url) as made:
        yield made


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (400, InvalidRequest),
        (401, Unauthorized),
        (404, NotFound),
        (409, Conflict),
        (410, Gone),
        (413, TooLarge),
        (415, UnsupportedMedia),
        (422, Unprocessable),
        (503, Unavailable),
        (500, PlacewiseError),
        (429, PlacewiseError),
    ],
)
def test_refusals_come_back_as_the_errors_that_they_were(
    server: FakeServer, client: Client, status: int, kind: type[PlacewiseError]
) -> None:
    problem = kind("some_code", "Some detail.", file_id="abc").as_problem()
    server.will_answer(status, {**problem, "instance": "/api/v1/uploads/abc"})
    with pytest.raises(PlacewiseError) as caught:
        client.photo("abc")
    assert type(caught.value) is kind
    assert (caught.value.code, caught.value.detail) == ("some_code", "Some detail.")
    assert caught.value.extra == {"file_id": "abc"}


@pytest.mark.parametrize("body", [b"<html>Bad Gateway</html>", b"", b"[]", b'"no"', b"null", b"{}"])
def test_what_is_no_problem_document_is_shown_with_its_status(
    server: FakeServer, client: Client, body: bytes
) -> None:
    server.will_answer(502, body)
    with pytest.raises(PlacewiseError) as caught:
        client.stats()
    assert caught.value.code == "bad_answer"
    assert "HTTP 502" in caught.value.detail


def test_server_that_is_not_there_is_unavailable_and_named() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        with Client(url) as client, pytest.raises(Unavailable) as caught:
            client.stats()
    assert caught.value.code == "server_unreachable"
    assert url in caught.value.detail


def test_upload_sends_the_file_and_only_the_fields_that_are_said(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    photo = tmp_path / "street.jpg"
    photo.write_bytes(b"the photo's bytes")
    server.will_answer(202, {"file_id": "abc"})
    assert client.upload(photo, latitude=45.5, place=None) == {"file_id": "abc"}
    method, path, body = server.asked[0]
    assert (method, path) == ("POST", "/api/v1/upload")
    assert b'filename="street.jpg"' in body
    assert b"the photo's bytes" in body
    assert b"45.5" in body
    assert b"place" not in body


def test_upload_may_be_called_otherwise_than_its_file(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    (tmp_path / "5f0e.jpg").write_bytes(b"bytes")
    server.will_answer(202, {})
    client.upload(tmp_path / "5f0e.jpg", filename="Piazza Castello.jpg")
    assert b'filename="Piazza Castello.jpg"' in server.asked[0][2]


def test_key_that_no_header_can_carry_is_refused(server: FakeServer) -> None:
    for key in ("schlüssel", "two\nlines"):
        with pytest.raises(InvalidRequest) as caught:
            Client(server.url, key=key)
        assert caught.value.code == "bad_key"
        assert key not in caught.value.detail


def test_file_that_cannot_be_read_is_an_error_before_anything_is_sent(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    with pytest.raises(InvalidRequest) as caught:
        client.upload(tmp_path / "missing.jpg")
    assert caught.value.code == "unreadable_file"
    assert server.asked == []


def test_map_is_named_in_every_call(server: FakeServer) -> None:
    server.will_answer(200, {})
    server.will_answer(200, {})
    with Client(server.url + "/", map_name="lab") as client:
        client.stats()
        client.search(filename="a b")
    assert server.asked[0][1] == "/api/v1/database/stats?map=lab"
    assert "map=lab" in server.asked[1][1]
    assert "filename=a" in server.asked[1][1]


def test_waiting_polls_until_the_job_has_ended(server: FakeServer, client: Client) -> None:
    for state in ("queued", "running", "succeeded"):
        server.will_answer(200, {"state": state})
    seen: list[str] = []
    job = client.wait_for("abc", lambda found: seen.append(found["state"]))
    assert job == {"state": "succeeded"}
    assert seen == ["queued", "running", "succeeded"]


def test_query_that_takes_longer_is_fetched_when_its_job_has_ended(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    photo = tmp_path / "where.jpg"
    photo.write_bytes(b"bytes")
    server.will_answer(202, {"job_id": "abc", "result_url": "/api/v1/queries/abc/similar"})
    server.will_answer(200, {"state": "succeeded"})
    server.will_answer(200, {"similar_images": []})
    assert client.similar_to_file(photo) == {"similar_images": []}
    assert [asked[1].split("?")[0] for asked in server.asked][1:] == [
        "/api/v1/jobs/abc",
        "/api/v1/queries/abc/similar",
    ]


def test_retrying_gives_up_with_the_last_error() -> None:
    def away() -> dict[str, Any]:
        raise Unavailable("server_unreachable", "No one there.")

    with pytest.raises(Unavailable):
        retry_while_away(away, seconds=-1)
    assert retry_while_away(lambda: {"here": True}, seconds=0) == {"here": True}


def test_retrying_stops_at_errors_that_waiting_does_not_cure() -> None:
    calls: list[int] = []

    def refused() -> dict[str, Any]:
        calls.append(1)
        raise NotFound("photo_not_found", "None.")

    with pytest.raises(NotFound):
        retry_while_away(refused, seconds=60)
    assert len(calls) == 1
