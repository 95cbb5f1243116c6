"""The object store away, silent or no S3 server: an error within seconds."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from shared.errors import Unavailable
from shared.storage.s3 import S3Store
from tests.contract.storage.test_s3_store import CALLS
from tests.support.servers import S3Server

MEGABYTE = 1_000_000
TIMEOUT_SECONDS = 5.0  # long enough to distinguish two waits from one on a busy machine
AT_ONCE_SECONDS = 4.0  # with one more try, on a busy machine


@contextlib.contextmanager
def unavailable(within_seconds: float) -> Iterator[None]:
    begun = time.monotonic()
    with pytest.raises(Unavailable) as caught:
        yield
    took = time.monotonic() - begun
    assert took < within_seconds, f"it took {took:.1f} s"
    assert caught.value.code == "object_store_unavailable"


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


def store_at(listener: socket.socket) -> S3Store:
    endpoint = f"127.0.0.1:{listener.getsockname()[1]}"
    server = S3Server(endpoint, "someone", "a secret", False, None)
    return S3Store(server.bucket("placewise", s3_timeout_seconds=TIMEOUT_SECONDS))


def test_silence_is_noticed_while_sending_too(listener: socket.socket) -> None:
    # More than the two ends' buffers hold: the request never comes to its end.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    begun = time.monotonic()
    with unavailable(2 * TIMEOUT_SECONDS - 0.5):
        store_at(listener).put("a", bytes(5 * MEGABYTE))
    assert time.monotonic() - begun > TIMEOUT_SECONDS - 0.5


def test_each_call_waits_for_a_silent_store_once(listener: socket.socket) -> None:
    def waits(call: Callable[[S3Store], object]) -> None:
        begun = time.monotonic()
        # The one that aborts what it has sent waits for that as well.
        with unavailable(2 * TIMEOUT_SECONDS - 0.5):
            call(store_at(listener))
        assert time.monotonic() - begun > TIMEOUT_SECONDS - 0.5

    with ThreadPoolExecutor(len(CALLS)) as pool:
        waiting = {name: pool.submit(waits, call) for name, call in CALLS.items()}
    failed = {name: str(error) for name, each in waiting.items() if (error := each.exception())}
    assert not failed


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())
def test_an_address_where_no_server_listens_is_an_error_at_once(
    listener: socket.socket, call: Callable[[S3Store], object]
) -> None:
    store = store_at(listener)
    listener.close()
    with unavailable(AT_ONCE_SECONDS):
        call(store)


def test_a_connection_that_is_cut_is_tried_once_more(listener: socket.socket) -> None:
    def serve() -> None:
        for answer in (b"", b"HTTP/1.1 200 OK\r\nETag: x\r\nContent-Length: 1\r\n\r\nx"):
            connection, _ = listener.accept()
            with connection:
                connection.recv(100_000)
                connection.sendall(answer)

    serving = threading.Thread(target=serve)
    serving.start()
    assert store_at(listener).get("a") == b"x"
    serving.join()


@pytest.mark.parametrize(
    "answer",
    [
        b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: 6\r\n\r\n<html>",
        b"HTTP/1.1 404 No\r\nContent-Type: text/html\r\nContent-Length: 6\r\n\r\n<html>",
        b"SSH-2.0-OpenSSH_9.2\r\n",
    ],
    ids=["page", "missing page", "no HTTP"],
)
def test_server_that_is_no_s3_is_reported(listener: socket.socket, answer: bytes) -> None:
    done = threading.Event()

    def serve() -> None:
        listener.settimeout(0.1)
        while not done.is_set():
            with contextlib.suppress(TimeoutError):
                connection, _ = listener.accept()
                with connection:
                    connection.settimeout(1)
                    connection.recv(100_000)
                    connection.sendall(answer)

    serving = threading.Thread(target=serve)
    serving.start()
    try:
        with pytest.raises(Unavailable, match="S3_ENDPOINT") as caught:
            list(store_at(listener).list(""))
    finally:
        done.set()
        serving.join()
    assert caught.value.code == "object_store_unavailable"
