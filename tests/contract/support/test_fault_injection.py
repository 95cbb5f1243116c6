"""The instruments of the fault suite do what they are named after."""

from __future__ import annotations

from collections.abc import Iterator
from http.server import ThreadingHTTPServer

import httpx2
import pytest
from redis import Redis

from shared.jobs.wakeups import WakeupQueue
from tests.support.fake_server import QuietHandler, serving
from tests.support.fault_injection import FaultProxy, MessageDuplicator, ProxyMode
from tests.support.servers import start_redis
from tests.support.servers.daemon import free_ports

BODY = bytes(range(256)) * 40


class Echo(QuietHandler):
    """Answers with what it was sent."""

    protocol_version = "HTTP/1.1"

    def do_PUT(self) -> None:  # noqa: N802
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.reply(200, body, {})

    def do_GET(self) -> None:  # noqa: N802
        # As S3 servers say it: the client is not to use it again.
        self.reply(200, BODY, {"Connection": "close"} if self.close_connection else {})


@pytest.fixture
def proxy() -> Iterator[FaultProxy]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Echo) as server:
        server.daemon_threads = True
        with serving(server), FaultProxy(free_ports(1)[0], server.server_port) as started:
            yield started


@pytest.fixture
def client(proxy: FaultProxy) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=f"http://127.0.0.1:{proxy.port}", timeout=20) as client:
        yield client


def test_a_fault_cuts_the_connection_that_stands_and_everything_passes_before_and_after_it(
    proxy: FaultProxy, client: httpx2.Client
) -> None:
    assert client.put("/", content=BODY).content == BODY
    with proxy.in_mode(ProxyMode.REFUSED), pytest.raises(httpx2.TransportError):
        client.get("/")
    assert client.put("/", content=BODY).content == BODY


def test_a_full_store_refuses_writes_and_answers_reads(
    proxy: FaultProxy, client: httpx2.Client
) -> None:
    with proxy.in_mode(ProxyMode.FULL):
        for _ in range(2):
            assert client.get("/").content == BODY
            assert client.put("/", content=BODY).status_code == 507


def test_every_message_is_there_twice() -> None:
    with start_redis(own=True) as server, Redis.from_url(server.url) as redis:
        doubler = MessageDuplicator(server.url)
        with doubler.duplicating():
            for number in range(10):
                redis.lpush(WakeupQueue.BULK, f'{{"body": "{number}"}}')
            while int(redis.llen(WakeupQueue.BULK)) < 20:
                pass
            redis.lpush("another list", "x")
        assert doubler.duplicated_messages == 10
        assert redis.llen("another list") == 1
