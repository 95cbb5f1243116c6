"""Connections of an HTTP server: too many of them, too slow ones, and clients that go away."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import re
import resource
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from ipaddress import ip_network
from typing import Any

import pytest
from fastapi import FastAPI, Request
from fastapi.responses import StreamingResponse

from services.http_connections import ConnectionLimits, Connections, Reason, address_group
from services.http_server import PEER_ADDRESS, http_server, listen
from services.request_log import RequestLogMiddleware, RequestRecord
from shared.config.settings import Settings
from shared.http.problem_details import CLIENT_GONE, install_exception_handlers
from tests.support.waiting import wait_until

LONG = 30.0
ASK = b"GET /whoami HTTP/1.1\r\nHost: localhost\r\n\r\n"
HEAD = b"POST /count HTTP/1.1\r\nHost: localhost\r\nContent-Length: 200000\r\n\r\n"
LIMITS = ConnectionLimits(total=100, per_address=50, head_seconds=LONG, body_bytes_per_second=0)


class Running:
    """A server in a thread."""

    def __init__(self, port: int, connections: Connections) -> None:
        self.port = port
        self.connections = connections
        self.calls: list[RequestRecord] = []
        self.hold = threading.Event()

    def connect(self, source: str = "127.0.0.1") -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), LONG, (source, 0))

    def ask(self, source: str = "127.0.0.1") -> bytes:
        with self.connect(source) as client:
            client.sendall(ASK)
            return answer_of(client)


@contextlib.contextmanager
def serving(**limits: Any) -> Iterator[Running]:
    """`limits` beside LIMITS."""
    with listen("127.0.0.1", 0) as listener:
        connections = Connections(replace(LIMITS, **limits))
        running = Running(listener.getsockname()[1], connections)
        app = FastAPI()
        install_exception_handlers(app)
        app.add_middleware(RequestLogMiddleware, on_end=running.calls.append)

        @app.get("/whoami")
        async def whoami(request: Request) -> str:
            assert request.client is not None
            return f"{request.client.host} from {request.scope[PEER_ADDRESS]}"

        @app.get("/held")
        def held() -> str:
            running.hold.wait(LONG)
            return "done"

        @app.post("/count")
        async def count(request: Request, wait: float = 0) -> int:
            await asyncio.sleep(wait)
            return len(await request.body())

        @app.post("/json")
        def parse(body: dict[str, int]) -> int:
            return len(body)

        @app.get("/much")
        async def much() -> StreamingResponse:
            async def pieces() -> Any:
                while True:
                    yield b"x" * 65536
                    await asyncio.sleep(0)  # to a client that has gone it is sent at once

            return StreamingResponse(pieces())

        server = http_server(app, connections)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            wait_until(lambda: server.started)
            yield running
        finally:
            running.hold.set()
            server.should_exit = True
            thread.join()


def answer_of(client: socket.socket) -> bytes:
    """The next answer, whose head says how long it is."""
    found = b""
    while (end := found.find(b"\r\n\r\n")) < 0 or len(found) < end + 4 + length_of(found):
        piece = client.recv(65536)
        assert piece, "the connection was closed"
        found += piece
    return found


def length_of(answer: bytes) -> int:
    length = re.search(rb"content-length: (\d+)", answer, re.IGNORECASE)
    assert length is not None
    return int(length[1])


def read_to_the_end(client: socket.socket) -> bytes:
    """What comes until the server closes the connection."""
    found = b""
    with contextlib.suppress(ConnectionResetError):
        while piece := client.recv(65536):
            found += piece
    return found


def test_idle_connections_make_room_for_calls_of_the_same_address() -> None:
    with serving(per_address=5) as server:
        idle = [server.connect() for _ in range(20)]
        assert b"200 OK" in server.ask()
        assert [read_to_the_end(client) for client in idle[:15]] == [b""] * 15, "the oldest"
        idle[-1].sendall(ASK)
        assert b"200 OK" in answer_of(idle[-1]), "the youngest is still open"
        assert server.connections.closed[Reason.ADDRESS_LIMIT] == 16
        assert server.connections.count <= 5
        for client in idle:
            client.close()


@pytest.mark.parametrize(
    ("limits", "status", "reason"),
    [
        ({"per_address": 2}, b"429 Too Many Requests", Reason.ADDRESS_LIMIT),
        ({"total": 2}, b"503 Service Unavailable", Reason.TOTAL_LIMIT),
    ],
)
def test_where_every_connection_is_at_work_a_further_one_is_refused(
    limits: dict[str, int], status: bytes, reason: Reason
) -> None:
    with serving(**limits) as server, server.connect() as one, server.connect() as two:
        for client in (one, two):
            client.sendall(ASK.replace(b"whoami", b"held"))
        wait_until(lambda: server.connections.count == 2 and not server.connections._idle)
        answer = server.ask()
        assert answer.startswith(b"HTTP/1.1 " + status)
        assert b"too_many_connections" in answer
        assert b"Retry-After: 1" in answer
        assert server.connections.closed[reason] == 1
        if reason == Reason.ADDRESS_LIMIT:
            assert b"200 OK" in server.ask("127.0.0.2"), "another address is answered"
        server.hold.set()
        for client in (one, two):
            assert b"200 OK" in answer_of(client), "nobody's call was cut short"


def test_a_connection_that_is_answered_makes_room_although_its_body_still_comes() -> None:
    with serving(per_address=1) as server, server.connect() as unread:
        unread.sendall(HEAD.replace(b"/count", b"/nowhere") + b"x")
        assert b"404 Not Found" in answer_of(unread)
        unread.sendall(b"x")
        assert b"200 OK" in server.ask()
        assert read_to_the_end(unread) == b""


def test_a_trusted_proxy_has_unlimited_connections_and_names_the_client_address() -> None:
    forwarded = ASK.replace(b"\r\n\r\n", b"\r\nX-Forwarded-For: 192.0.2.7\r\n\r\n")
    with serving(per_address=2, trusted_proxies=(ip_network("127.0.0.2/32"),)) as server:
        with contextlib.ExitStack() as held:
            proxied = [held.enter_context(server.connect("127.0.0.2")) for _ in range(5)]
            for client in proxied:
                client.sendall(forwarded)
                assert b"192.0.2.7 from 127.0.0.2" in answer_of(client)
        with server.connect() as stranger:
            stranger.sendall(forwarded)
            assert b"127.0.0.1 from 127.0.0.1" in answer_of(stranger), "others are not believed"


def test_a_head_that_does_not_come_in_time_ends_the_connection() -> None:
    with serving(head_seconds=1.0) as server:
        with server.connect() as silent, server.connect() as slow, server.connect() as retained:
            slow.sendall(b"GET /whoami HT")
            retained.sendall(ASK)
            assert b"200 OK" in answer_of(retained)
            assert read_to_the_end(silent) == read_to_the_end(slow) == b""
            retained.sendall(ASK)
            assert b"200 OK" in answer_of(retained), "it may be idle between two calls"
            retained.sendall(b"GET /")
            assert read_to_the_end(retained) == b"", "not within one"
        assert server.connections.closed[Reason.SLOW_HEAD] == 3
        wait_until(lambda: server.connections.count == 0)


def test_a_body_that_comes_too_slowly_is_answered_408_and_no_error_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with serving(body_bytes_per_second=1000, body_window_seconds=0.5) as server:
        with server.connect() as slow, server.connect() as slow_json, server.connect() as fast:
            slow.sendall(HEAD + b"x")
            slow_json.sendall(HEAD.replace(b"/count", b"/json") + b"x")
            fast.sendall(HEAD)
            for _ in range(20):
                fast.sendall(b"x" * 10_000)
                time.sleep(0.1)
            assert b"200000" in answer_of(fast)
            for client in (slow, slow_json):
                answer = read_to_the_end(client)
                assert answer.startswith(b"HTTP/1.1 408 Request Timeout")
                assert b"request_too_slow" in answer
        wait_until(lambda: len(server.calls) == 3)
        assert server.connections.closed[Reason.SLOW_BODY] == 2
        assert sorted(call.status for call in server.calls) == [200, 408, 408]
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


def test_the_time_limit_of_a_body_excludes_waits_for_the_server() -> None:
    with (
        serving(body_bytes_per_second=1_000_000, body_window_seconds=0.5) as server,
        server.connect() as client,
        server.connect() as polite,
    ):
        later = HEAD.replace(b"/count", b"/count?wait=2.5")
        client.sendall(later + b"x" * 200_000)
        polite.sendall(later[:-2] + b"Expect: 100-continue\r\n\r\n")
        assert b"200000" in answer_of(client)
        assert b"100 Continue" in polite.recv(65536)
        polite.sendall(b"x" * 200_000)
        assert b"200000" in answer_of(polite)


def test_a_client_that_disconnects_counts_as_499_without_a_traceback(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with serving() as server:
        with server.connect() as client:
            client.sendall(HEAD + b"x")
            time.sleep(0.2)
        wait_until(lambda: server.calls)
        assert server.calls[0].status == CLIENT_GONE
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


def test_a_response_that_the_client_does_not_read_ends_the_connection() -> None:
    with serving(stalled_seconds=1.0) as server:
        with server.connect() as reading, server.connect() as stalled:
            for client in (reading, stalled):
                client.sendall(ASK.replace(b"whoami", b"much"))
            until = time.monotonic() + 4
            while time.monotonic() < until:
                assert reading.recv(1_000_000)
                time.sleep(0.01)
            wait_until(lambda: server.connections.closed[Reason.SLOW_READER] == 1)
            assert reading.recv(65536)
        wait_until(lambda: server.connections.count == 0)


def test_accept_errors_are_counted_and_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    connections = Connections(LIMITS)
    passed: list[dict[str, Any]] = []

    class Loop:
        def default_exception_handler(self, context: dict[str, Any]) -> None:
            passed.append(context)

    for _ in range(1000):
        connections.on_loop_error(Loop(), {"exception": OSError(errno.EMFILE, "too many")})
    assert connections.closed[Reason.ACCEPT_ERROR] == 1000
    assert not caplog.records
    connections.on_loop_error(Loop(), {"exception": ValueError("ours")})
    assert len(passed) == 1


@pytest.mark.parametrize(
    ("soft", "hard", "files", "total"),
    [
        (1024, 1024, 1024, 768),
        (1024, 4096, 4096, 2000),
        (256, 256, 256, 128),
        (1024, resource.RLIM_INFINITY, 65_536, 2000),
        (200_000, 200_000, 200_000, 2000),
    ],
)
def test_connections_stay_below_what_the_process_may_open(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, files: int, total: int
) -> None:
    limit = [(soft, hard)]
    monkeypatch.setattr(resource, "getrlimit", lambda _: limit[0])
    monkeypatch.setattr(resource, "setrlimit", lambda _, value: limit.__setitem__(0, value))
    assert ConnectionLimits.of(Settings(max_connections=2000)).total == total
    assert limit[0] == (files, hard)


@pytest.mark.parametrize(
    ("address", "group"),
    [
        ("192.0.2.1", "192.0.2.1"),
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("a socket of this machine", "a socket of this machine"),
        ("", ""),
    ],
)
def test_an_ipv6_customer_counts_as_one_address(address: str, group: str) -> None:
    assert address_group(address) == group


@pytest.mark.parametrize(
    ("address", "limit"),
    [("10.0.0.5", 0), ("::ffff:10.0.0.5", 0), ("10.0.1.5", 2), ("2001:db8::1", 2), ("", 2)],
)
def test_a_trusted_proxy_is_unlimited_on_a_server_for_ipv4_and_ipv6(
    address: str, limit: int
) -> None:
    limits = ConnectionLimits(9, 2, 1.0, 0, trusted_proxies=(ip_network("10.0.0.0/24"),))
    assert limits.of_address(address) == limit


def test_the_total_limit_holds_under_concurrent_connects() -> None:
    with serving(total=30, per_address=0) as server, contextlib.ExitStack() as held:
        clients = [held.enter_context(server.connect()) for _ in range(300)]
        wait_until(lambda: server.connections.closed[Reason.TOTAL_LIMIT] == 270)
        assert server.connections.count == 30
        assert b"200 OK" in server.ask()
        assert sum(1 for client in clients if is_open(client)) <= 30


def is_open(client: socket.socket) -> bool:
    client.setblocking(False)
    try:
        return client.recv(1) != b""
    except BlockingIOError:
        return True
    except ConnectionResetError:
        return False
