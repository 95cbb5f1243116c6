"""The object store away, silent, or killed in the middle: an error within seconds, nothing torn."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from shared.errors import Unavailable
from shared.storage.s3 import S3Store
from tests.contract.storage.test_s3_store import CALLS
from tests.support.servers import S3Server, start_s3

MEGABYTE = 1_000_000
TIMEOUT_SECONDS = 3.0  # long enough to distinguish two waits from one on a busy machine
AT_ONCE_SECONDS = 4.0  # with one more try, on a busy machine


@pytest.fixture(scope="module")
def breakable() -> Iterator[S3Server]:
    """A server of this module's own."""
    with start_s3(own=True) as server:
        yield server


@pytest.fixture
def store(breakable: S3Server) -> S3Store:
    return S3Store(breakable.new_bucket())


@contextlib.contextmanager
def unavailable(within_seconds: float) -> Iterator[None]:
    begun = time.monotonic()
    with pytest.raises(Unavailable) as caught:
        yield
    took = time.monotonic() - begun
    assert took < within_seconds, f"it took {took:.1f} s"
    assert caught.value.code == "object_store_unavailable"


def test_server_killed_in_the_middle_of_a_put_leaves_no_object(
    breakable: S3Server, store: S3Store
) -> None:
    assert breakable.process is not None
    store.put("originals/before", b"acknowledged")
    writer = store.writer("originals/a")
    writer.write(os.urandom(12 * MEGABYTE))
    breakable.process.kill()
    with unavailable(AT_ONCE_SECONDS):
        writer.write(os.urandom(12 * MEGABYTE))
    writer.abort()
    breakable.process.start()
    assert store.head("originals/a") is None
    assert [info.key for info in store.list("")] == ["originals/before"]
    assert store.get("originals/before") == b"acknowledged"
    store.put("originals/a", b"the same process goes on")


def test_server_killed_in_the_middle_of_a_get_gives_no_torn_object(
    breakable: S3Server, store: S3Store
) -> None:
    assert breakable.process is not None
    data = os.urandom(40 * MEGABYTE)
    store.put("chunks/a", data)
    with store.open("chunks/a") as file:
        assert file.read(1000) == data[:1000]
        breakable.process.kill()
        with unavailable(AT_ONCE_SECONDS):
            file.read()
    with unavailable(AT_ONCE_SECONDS):
        store.get("chunks/a")
    breakable.process.start()
    assert store.get("chunks/a") == data, "what was acknowledged outlives the kill"


def test_paused_server_is_given_up_after_the_configured_time(breakable: S3Server) -> None:
    assert breakable.process is not None
    bucket = breakable.new_bucket()
    store = S3Store(bucket)
    store.put("a", b"x")
    hasty = S3Store(breakable.bucket(bucket.name, s3_timeout_seconds=TIMEOUT_SECONDS))
    breakable.process.pause()
    try:
        for call in (hasty.check, lambda: hasty.get("a"), lambda: hasty.put("a", b"new")):
            with unavailable(TIMEOUT_SECONDS + AT_ONCE_SECONDS):
                call()
    finally:
        breakable.process.resume()
    store.check()
    assert store.get("a") in (b"x", b"new"), "a put without an answer is done or not, never torn"


# --- without a server ------------------------------------------------------------------------


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


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())
def test_silence_is_waited_for_once(
    listener: socket.socket, call: Callable[[S3Store], object]
) -> None:
    begun = time.monotonic()
    # The one that aborts what it has sent waits for that as well.
    with unavailable(2 * TIMEOUT_SECONDS - 0.5):
        call(store_at(listener))
    assert time.monotonic() - begun > TIMEOUT_SECONDS - 0.5


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
