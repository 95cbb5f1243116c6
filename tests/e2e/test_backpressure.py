"""A busy server: what it refuses, what it still answers, and a command that waits and goes on."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path

import pytest

from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import problem
from tests.support.server import ServerProcess, environment, run_command

SETTINGS = {"max_queued_jobs": 1, "max_concurrent_uploads": 1}
PHOTOS = 5
DONE_SECONDS = 30.0


def begin_upload(server: ServerProcess, data: bytes) -> tuple[socket.socket, bytes]:
    """An upload of which only a half has come, and its other half."""
    body = (
        b'--b\r\nContent-Disposition: form-data; name="file"; filename="slow.jpg"\r\n\r\n'
        + data
        + b"\r\n--b--\r\n"
    )
    url = server.client.base_url
    slow = socket.create_connection((url.host, url.port or 80), timeout=30)
    slow.sendall(
        b"POST /api/v1/upload HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
        b"Content-Type: multipart/form-data; boundary=b\r\n"
        + f"Content-Length: {len(body)}\r\n\r\n".encode()
    )
    slow.sendall(body[:-100])
    return slow, body[-100:]


def receiving(server: ServerProcess) -> int:
    load = server.client.get("/api/v1/health").json()["load"]
    count: int = load["receiving_uploads"]
    return count


def half_received(server: ServerProcess) -> tuple[socket.socket, bytes]:
    """An upload that is being received. The queue's limit is 1 as well: while the photo before
    still counts, it is turned away."""
    deadline = time.monotonic() + DONE_SECONDS
    while True:
        slow, rest = begin_upload(server, photo_bytes(100))
        again = time.monotonic() + 2
        while time.monotonic() < again:
            if receiving(server):
                return slow, rest
            time.sleep(0.05)
        slow.close()
        assert time.monotonic() < deadline


@pytest.fixture(autouse=True)
def _nothing_waits(server: ServerProcess) -> None:
    deadline = time.monotonic() + DONE_SECONDS
    while server.client.get("/api/v1/health").json()["load"]["waiting_jobs"]:
        assert time.monotonic() < deadline
        time.sleep(0.2)


def test_one_concurrent_upload_too_many_gets_retry_after(server: ServerProcess) -> None:
    slow, rest = half_received(server)
    with slow:
        # The queue's limit is 1 as well, and what was begun counts until the next look.
        while True:
            refused = server.upload(photo_bytes(101))
            if refused.json()["code"] != "queue_full":
                break
            time.sleep(0.2)
        problem(refused, 429, "too_many_uploads")
        assert int(refused.headers["retry-after"]) >= 1
        assert server.ask(near_copy(0)).status_code == 200, "a query photo has room of its own"
        slow.sendall(rest)
        assert b"202 Accepted" in slow.recv(1000)
    assert receiving(server) == 0


def test_index_waits_for_a_full_queue_says_so_and_goes_on(
    server: ServerProcess, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(PHOTOS):
        (folder / f"{number}.jpg").write_bytes(photo_bytes(300 + number))
    ended = run_command(
        *("index", folder, "--no-fit", "--json"), env=environment(server.home), cwd=tmp_path
    )
    assert ended.returncode == 0, ended.stderr
    report = json.loads(ended.stdout)
    assert (report["uploaded"], report["refused"], report["failed"]) == (PHOTOS, [], [])
    assert "Retrying:" in ended.stderr
    assert "The queue is full" in ended.stderr
