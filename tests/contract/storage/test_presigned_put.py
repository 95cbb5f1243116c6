"""Sending an object to a bucket without keys: what the address allows, and what it refuses."""

from __future__ import annotations

import hashlib
import os

import pytest
import urllib3

from shared.errors import NotFound
from shared.storage import PresignedPut
from shared.storage.s3 import S3Store
from tests.support.servers import S3Server

DATA = os.urandom(100_000)


@pytest.fixture(params=["s3", "moto"])
def store(request: pytest.FixtureRequest) -> S3Store:
    server: S3Server = request.getfixturevalue(request.param)
    return S3Store(server.new_bucket())


@pytest.fixture
def strict(s3: S3Server) -> S3Store:
    """On a server that checks what was signed, as moto does not."""
    return S3Store(s3.new_bucket())


def presign(store: S3Store, key: str = "incoming/a", seconds: int = 60) -> PresignedPut:
    digest = hashlib.sha256(DATA).hexdigest()
    return store.presign_put(key, size_bytes=len(DATA), sha256=digest, expires_seconds=seconds)


def put(url: str, data: bytes, headers: dict[str, str]) -> int:
    return urllib3.request("PUT", url, body=data, headers=headers, retries=False).status


@pytest.mark.parametrize("key", ["incoming/a", "incoming/a b+c=é"])
def test_the_announced_bytes_arrive_also_if_they_are_sent_again(store: S3Store, key: str) -> None:
    put_here = presign(store, key)
    for _ in range(2):
        assert put(put_here.url, DATA, put_here.headers) == 200
    assert store.get(key) == DATA


def test_other_bytes_another_size_and_another_key_are_refused(strict: S3Store) -> None:
    put_here = presign(strict)
    size = {"Content-Length": str(len(DATA) - 1)}
    assert put(put_here.url, os.urandom(len(DATA)), put_here.headers) == 400
    assert put(put_here.url, DATA[:-1], {**put_here.headers, **size}) == 403
    assert put(put_here.url.replace("incoming/a", "originals/a"), DATA, put_here.headers) == 403
    unsigned = {k: v for k, v in put_here.headers.items() if k == "Content-Length"}
    assert put(put_here.url, DATA, unsigned) == 403
    assert urllib3.request("GET", put_here.url, retries=False).status == 403
    assert list(strict.list("")) == []


def test_a_presigned_url_expires(strict: S3Store) -> None:
    put_here = presign(strict, seconds=-1)
    assert put(put_here.url, DATA, put_here.headers) in (400, 403)
    assert list(strict.list("")) == []


def test_callers_are_sent_to_the_public_address_and_the_signature_is_for_it(
    s3: S3Server,
) -> None:
    name = s3.new_bucket().name
    inner = s3.bucket(name)
    outer = s3.bucket(name, s3_public_endpoint="https://photos.example.com")
    assert presign(S3Store(outer)).url.startswith(f"https://photos.example.com/{name}/incoming/a?")
    # "localhost" stands for another name of the same server: signed for one, good for no other.
    port = s3.endpoint.rpartition(":")[2]
    local = S3Store(s3.bucket(name, s3_public_endpoint=f"http://localhost:{port}"))
    put_here = presign(local)
    assert put(put_here.url.replace("localhost", "127.0.0.1"), DATA, put_here.headers) == 403
    assert put(put_here.url, DATA, put_here.headers) == 200
    assert S3Store(inner).get("incoming/a") == DATA


def test_a_copy_stays_what_it_is_and_one_of_nothing_is_not_found(store: S3Store) -> None:
    with pytest.raises(NotFound) as caught:
        store.copy("incoming/none", "originals/a")
    assert caught.value.code == "object_not_found"
    assert list(store.list("")) == []
    store.put("incoming/a", b"first")
    store.copy("incoming/a", "originals/a")
    store.put("incoming/a", b"second")
    store.delete("incoming/a")
    assert store.get("originals/a") == b"first"


def test_the_metadata_of_the_sender_is_not_copied(store: S3Store) -> None:
    put_here = presign(store)
    fields = {"Content-Type": "text/html", "Content-Encoding": "gzip"}
    assert put(put_here.url, DATA, {**put_here.headers, **fields}) == 200
    store.copy("incoming/a", "originals/a")
    copied = store.bucket.client.stat_object(store.bucket.name, "originals/a")
    assert copied.metadata is not None
    assert copied.metadata.get("content-encoding") != "gzip"
    assert copied.content_type != "text/html"
    assert store.get("originals/a") == DATA
