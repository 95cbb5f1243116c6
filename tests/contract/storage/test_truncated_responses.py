"""A connection to the S3 store that ends at any byte of an answer is a clear error."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from benchmarks.fleet.fault_injection import FaultProxy, ProxyMode
from shared.errors import PlacewiseError
from shared.storage.s3 import S3Store
from tests.support.servers import start_moto
from tests.support.servers.daemon import free_ports
from tests.support.servers.s3 import S3Server

KEY, BODY = "a/b", bytes(range(256))
STEP_BYTES = 7  # a prime: the places differ from one line of an answer's head to the next
LONGEST_BYTES = 3000

CALLS: dict[str, Callable[[S3Store], object]] = {
    "put": lambda store: store.put(KEY, BODY),
    "get": lambda store: store.get(KEY),
    "read_range": lambda store: store.read_range(KEY, 10, 100),
    "head": lambda store: store.head(KEY),
    "head of nothing": lambda store: store.head("nothing"),
    "list": lambda store: [found.key for found in store.list("a/")],
    "copy": lambda store: store.copy(KEY, "copied"),
    "delete": lambda store: store.delete("gone"),
    "check": lambda store: store.check(),
}


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    with start_moto() as server:
        yield server


@pytest.fixture(scope="module")
def proxy(server: S3Server) -> Iterator[FaultProxy]:
    with FaultProxy(free_ports(1)[0], int(server.endpoint.rpartition(":")[2])) as proxy:
        yield proxy


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())
def test_answer_that_is_cut_anywhere_is_no_answer(
    server: S3Server, proxy: FaultProxy, call: Callable[[S3Store], object]
) -> None:
    bucket = server.new_bucket()
    S3Store(bucket).put(KEY, BODY)
    right = call(S3Store(bucket))
    came = 0
    for place in range(0, LONGEST_BYTES, STEP_BYTES):
        fresh = S3Store(server.bucket(bucket.name, s3_endpoint=f"127.0.0.1:{proxy.port}"))
        with proxy.in_mode(ProxyMode.CUT_ANSWER, cut_after_bytes=place):
            answer, refused = _outcome(call, fresh)
        if refused is not None:
            assert refused == "object_store_unavailable", place
            assert not came, f"it had been whole before it was cut after {place} bytes"
            continue
        assert answer == right, place
        came += 1
        if came == 3:
            break
    assert came == 3
    assert place > 100, "it was never cut"


def _outcome(call: Callable[[S3Store], object], store: S3Store) -> tuple[object, str | None]:
    """What it answers, and the code of what it raises."""
    try:
        return call(store), None
    except PlacewiseError as error:
        return None, error.code
