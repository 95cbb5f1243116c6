"""Clients that are slow on purpose: others are answered meanwhile, and limits answer by name."""

from __future__ import annotations

import contextlib
import socket
import time
from pathlib import Path

import psutil

from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess

ADMIN_KEY = "the-admin-key-of-slow-clients"
IDLE, BODIES, POLLS = 150, 8, 14
SECONDS = 90.0
FILES = 400  # that the server may open


def connect(server: ServerProcess, source: str, head: str = "") -> socket.socket:
    """A connection from another address of this machine, over which the head was sent."""
    url = server.client.base_url
    client = socket.create_connection((url.host, url.port or 80), SECONDS, (source, 0))
    if head:
        lines = [head, "Host: localhost", f"Authorization: Bearer {ADMIN_KEY}"]
        client.sendall("\r\n".join([*lines, "", ""]).encode())
    return client


def read_first_object(client: socket.socket) -> bytes:
    """The answer up to the end of its first JSON object, which may come in several packets."""
    received = b""
    while b"}" not in received and (packet := client.recv(65536)):
        received += packet
    return received


def test_calls_are_answered_while_others_are_slow_and_limits_answer_by_name(
    tmp_path: Path,
) -> None:
    upload = (
        "POST /api/v1/upload HTTP/1.1\r\nContent-Length: 1000000\r\n"
        "Content-Type: multipart/form-data; boundary=b"
    )
    server = ServerProcess(
        tmp_path / "home",
        admin_key=ADMIN_KEY,
        extractor="test-tiny-vlad",  # its jobs wait for a vocabulary
        max_connections=100,
        max_connections_per_address=60,
        max_concurrent_uploads=8,
    )
    with server, contextlib.ExitStack() as held:
        psutil.Process(server.process.pid).rlimit(psutil.RLIMIT_NOFILE, (FILES, FILES))
        job = server.upload(photo_bytes(1)).json()
        log_bytes = server.log_path.stat().st_size
        poll = f"GET {job['status_url']}?wait=60 HTTP/1.1"

        for _ in range(IDLE):  # from its own address, the client's connection would be closed, too
            held.enter_context(connect(server, "127.0.0.4"))
        bodies = [held.enter_context(connect(server, "127.0.0.2", upload)) for _ in range(BODIES)]
        polls = [held.enter_context(connect(server, "127.0.0.3", poll)) for _ in range(POLLS)]
        for number in range(10):
            assert server.client.get("/readyz").status_code == 200
            assert server.client.get("/api/v1/maps").status_code == 200
            assert server.upload(photo_bytes(10 + number)).status_code == 202
        refusals = sorted(body.recv(65536).split()[1] for body in bodies)
        assert refusals == 4 * [b"408"] + 4 * [b"429"], "half of the places, and not for long"
        text = server.client.get("/metrics").text
        assert 'connections_closed_total{reason="address_limit"}' in text
        assert 'connections_closed_total{reason="accept_error"} 0.0' in text
        assert server.log_path.stat().st_size - log_bytes < 100_000
        assert "Traceback" not in server.log()

        began = time.monotonic()
        assert server.stop() == 0
        assert time.monotonic() - began < SECONDS, "long polls do not hold up the end"
        answers = [read_first_object(poll) for poll in polls]
        assert [answer for answer in answers if b" 200 OK" not in answer] == []
