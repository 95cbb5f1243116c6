"""A connection to the S3 store that ends within an answer is a clear error."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from shared.config.settings import Settings
from shared.errors import PlacewiseError
from shared.storage.s3 import Bucket, S3Store
from tests.support.fault_injection import FaultProxy, ProxyMode
from tests.support.servers.daemon import free_ports
from tests.support.servers.s3 import S3Server

pytestmark = pytest.mark.servers

KEY, BODY = "a/b", bytes(range(256))
STEP_BYTES = 7  # a prime: the places differ from one line of an answer's head to the next
LONGEST_BYTES = 3000

# The calls, and at least how many bytes the body of the last answer has.
CALLS: dict[str, tuple[Callable[[S3Store], object], int]] = {
    "put": (lambda store: store.put(KEY, BODY), 0),
    "get": (lambda store: store.get(KEY), len(BODY)),
    "open": (lambda store: store.open(KEY).read(), len(BODY)),
    "read_range": (lambda store: store.read_range(KEY, 10, 100), 100),
    "head": (lambda store: store.head(KEY), 0),
    "head of nothing": (lambda store: store.head("nothing"), 0),
    "list": (lambda store: [found.key for found in store.list("a/")], 200),
    "move": (lambda store: _put_and_move(store), 100),
    "delete": (lambda store: store.delete("gone"), 0),
    "check": (lambda store: store.check(), 0),
}


@pytest.fixture(scope="module")
def proxy(moto: S3Server) -> Iterator[FaultProxy]:
    with FaultProxy(free_ports(1)[0], int(moto.endpoint.rpartition(":")[2])) as proxy:
        yield proxy


@pytest.mark.parametrize(("call", "body_bytes"), CALLS.values(), ids=CALLS.keys())
def test_answer_whose_body_is_cut_is_no_answer(
    moto: S3Server, proxy: FaultProxy, call: Callable[[S3Store], object], body_bytes: int
) -> None:
    """Within the head no other error comes than that of a store that can't be used."""
    bucket = moto.new_bucket()
    S3Store(bucket).put(KEY, BODY)
    right = call(S3Store(bucket))
    codes: list[str | None] = []
    came = 0
    variables = moto.variables(bucket.name) | {"s3_endpoint": f"127.0.0.1:{proxy.port}"}
    settings = Settings(**variables)
    for place in range(0, LONGEST_BYTES, STEP_BYTES):
        with proxy.in_mode(ProxyMode.CUT_ANSWER, cut_after_bytes=place):
            answer, code = _outcome(call, S3Store(Bucket.from_settings(settings)))
        codes.append(code)
        came = came + 1 if code is None and answer == right else 0
        if came >= 3 and place > body_bytes + 100:
            break
    assert came >= 3
    assert set(codes) == {"object_store_unavailable", None}
    body = codes[: len(codes) - came][len(codes) - came - body_bytes // STEP_BYTES :]
    assert set(body) <= {"object_store_unavailable"}


def _put_and_move(store: S3Store) -> None:
    store.put(KEY, BODY)
    store.move(KEY, "moved")


def _outcome(call: Callable[[S3Store], object], store: S3Store) -> tuple[object, str | None]:
    """What it answers, and the code of what it raises."""
    try:
        return call(store), None
    except PlacewiseError as error:
        return None, error.code
