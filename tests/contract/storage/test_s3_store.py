"""What a bucket does beyond the contract: refusals that say what to do, parts, ranges, its rule."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from minio.lifecycleconfig import LifecycleConfig
from urllib3.exceptions import ProtocolError

from shared.config.settings import Settings
from shared.errors import Misconfigured, Unavailable
from shared.storage import FolderStore, ObjectStore
from shared.storage.open_store import open_store
from shared.storage.s3 import Bucket, S3Store, create_bucket
from shared.storage.s3.streams import PART_BYTES
from tests.support.clock import clock_off_by
from tests.support.commands import run
from tests.support.servers import S3Server


def write_large(store: ObjectStore) -> None:
    writer = store.writer("a")
    try:
        writer.write(bytes(PART_BYTES + 1))
    finally:
        writer.abort()


READS: dict[str, Callable[[ObjectStore], object]] = {
    "check": lambda store: store.check(),
    "get": lambda store: store.get("a"),
    "open": lambda store: store.open("a"),
    "read_range": lambda store: store.read_range("a", 0, 1),
    "head": lambda store: store.head("a"),
    "list": lambda store: list(store.list("")),
}
CALLS: dict[str, Callable[[ObjectStore], object]] = {
    **READS,
    "put": lambda store: store.put("a", b"x"),
    "writer": write_large,
    "delete": lambda store: store.delete("a"),
}
every_call = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())
every_read = pytest.mark.parametrize("call", READS.values(), ids=READS.keys())


@pytest.fixture
def bucket(s3: S3Server) -> Bucket:
    return s3.new_bucket()


def unfinished(bucket: Bucket) -> list[str | None]:
    found = bucket.client._list_multipart_uploads(bucket.name)
    return [upload.object_name for upload in found.uploads]


# --- refusals --------------------------------------------------------------------------------


@every_call
@pytest.mark.parametrize(
    "wrong", [{"s3_secret_key": "not the secret"}, {"s3_access_key": "nobody"}], ids=str
)
def test_wrong_keys_are_refused_and_named(
    s3: S3Server, bucket: Bucket, wrong: dict[str, str], call: Callable[[ObjectStore], object]
) -> None:
    with pytest.raises(Unavailable) as caught:
        call(S3Store(s3.bucket(bucket.name, **wrong)))
    assert caught.value.code == "object_store_refused"
    assert "S3_SECRET_KEY" in caught.value.detail
    assert "not the secret" not in caught.value.detail
    assert list(S3Store(bucket).list("")) == []


@every_read
def test_missing_bucket_says_how_to_make_it(
    s3: S3Server, call: Callable[[ObjectStore], object]
) -> None:
    with pytest.raises(Unavailable) as caught:
        call(S3Store(s3.bucket("never-made")))
    assert caught.value.code == "bucket_not_found"
    assert "'never-made'" in caught.value.detail
    assert "placewise storage create-bucket" in caught.value.detail


def test_https_with_a_server_that_speaks_http_names_the_setting(
    s3: S3Server, bucket: Bucket
) -> None:
    with pytest.raises(Unavailable, match="S3_SECURE") as caught:
        S3Store(s3.bucket(bucket.name, s3_secure=not s3.secure)).check()
    assert caught.value.code == "object_store_unavailable"


# --- parts -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "parts"),
    [(PART_BYTES - 1, 0), (PART_BYTES, 0), (PART_BYTES + 1, 2), (2 * PART_BYTES, 2)],
)
def test_object_that_fits_into_one_part_is_one_request(
    bucket: Bucket, size: int, parts: int
) -> None:
    data = os.urandom(size)
    writer = S3Store(bucket).writer("a")
    for begin in range(0, size, 700_001):
        writer.write(data[begin : begin + 700_001])
    writer.commit()
    assert S3Store(bucket).get("a") == data
    # S3's way to say of how many parts an object was made.
    etag = bucket.client.stat_object(bucket.name, "a").etag or ""
    assert etag.partition("-")[2] == (str(parts) if parts else "")
    assert unfinished(bucket) == []


def test_aborted_upload_leaves_no_parts(bucket: Bucket) -> None:
    writer = S3Store(bucket).writer("a")
    writer.write(bytes(2 * PART_BYTES))
    assert unfinished(bucket) == ["a"]
    writer.abort()
    assert unfinished(bucket) == []
    writer.abort()


def test_put_that_fails_midway_leaves_no_parts(
    bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload_part = bucket.client._upload_part

    def first_only(*arguments: Any) -> str:
        if arguments[-1] == 2:
            raise ProtocolError("Connection aborted.")
        return upload_part(*arguments)

    monkeypatch.setattr(bucket.client, "_upload_part", first_only)
    with pytest.raises(Unavailable):
        S3Store(bucket).put("a", bytes(3 * PART_BYTES))
    assert unfinished(bucket) == []
    assert S3Store(bucket).head("a") is None


def test_upload_whose_parts_were_removed_meanwhile_is_not_acknowledged(bucket: Bucket) -> None:
    writer = S3Store(bucket).writer("a")
    writer.write(bytes(PART_BYTES + 1))
    found = bucket.client._list_multipart_uploads(bucket.name).uploads[0]
    bucket.client._abort_multipart_upload(bucket.name, "a", str(found.upload_id))
    with pytest.raises(Unavailable):
        writer.commit()
    writer.abort()
    assert S3Store(bucket).head("a") is None


# --- reading ---------------------------------------------------------------------------------


def test_seeking_fetches_from_there_and_not_all(
    bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    S3Store(bucket).put("a", bytes(1_000_000))
    offsets: list[int] = []
    get_object = bucket.client.get_object

    def noted(*arguments: Any, **options: Any) -> Any:
        offsets.append(options["offset"])
        return get_object(*arguments, **options)

    monkeypatch.setattr(bucket.client, "get_object", noted)
    with S3Store(bucket).open("a") as file:
        file.read(100)
        file.seek(50)
        file.read(100)
        assert offsets == [0], "what is in the buffer is not requested again"
        file.seek(-10, os.SEEK_END)
        file.seek(600_000)
        assert offsets == [0], "nothing is fetched before it is read"
        file.read(10)
        file.seek(2_000_000)
        assert file.read() == b""
    assert offsets == [0, 600_000]


def test_object_that_is_replaced_while_it_is_read_is_never_mixed(bucket: Bucket) -> None:
    store = S3Store(bucket)
    store.put("a", b"1" * 1_000_000)
    with store.open("a") as file:
        assert file.read(10) == b"1" * 10
        store.put("a", b"2" * 1_000_000)
        file.seek(900_000)
        with pytest.raises(Unavailable) as caught:
            file.read()
    assert caught.value.code == "object_changed"


def test_connections_are_given_back(bucket: Bucket) -> None:
    store = S3Store(bucket)
    store.put("a", bytes(100_000))
    for _ in range(3):
        store.get("a")
        with store.open("a") as file:
            file.read()
        store.head("a")
    pools = bucket.client._http.pools
    assert [pools[key].num_connections for key in pools.keys()] == [1]  # noqa: SIM118


# --- its making ------------------------------------------------------------------------------


def test_bucket_is_made_once_and_with_the_rule_for_unfinished_uploads(s3: S3Server) -> None:
    bucket = s3.new_bucket()
    assert create_bucket(bucket) is False
    rules = bucket.client.get_bucket_lifecycle(bucket.name)
    assert rules is not None
    assert [rule.rule_id for rule in rules.rules] == ["placewise-unfinished-uploads"]


def test_bucket_that_someone_else_has_made_gets_the_rule_and_keeps_its_own(
    s3: S3Server, bucket: Bucket
) -> None:
    other = s3.bucket(f"{bucket.name}-2")
    other.client.make_bucket(other.name)
    assert create_bucket(other) is False
    assert other.client.get_bucket_lifecycle(other.name) is not None

    rules = bucket.client.get_bucket_lifecycle(bucket.name)
    assert rules is not None
    theirs = [dataclasses.replace(rule, rule_id="theirs") for rule in rules.rules]
    bucket.client.set_bucket_lifecycle(bucket.name, LifecycleConfig(theirs))
    create_bucket(bucket)
    lifecycle = bucket.client.get_bucket_lifecycle(bucket.name)
    assert lifecycle is not None
    assert [rule.rule_id for rule in lifecycle.rules] == ["theirs"]


def test_command_makes_the_bucket_and_is_content_with_one(
    s3: S3Server, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"{bucket.name}-cli"
    for variable, value in s3.variables(name).items():
        monkeypatch.setenv(variable.upper(), str(value))
    assert "was created" in run("storage", "create-bucket").stdout
    assert "already exists" in run("storage", "create-bucket").stdout
    S3Store(s3.bucket(name)).check()


def test_command_without_an_endpoint_says_what_to_set() -> None:
    assert "S3_ENDPOINT" in run("storage", "create-bucket", code=1).output


# --- which store ------------------------------------------------------------------------------


def test_the_folder_is_the_store_unless_an_endpoint_is_set(
    s3: S3Server, bucket: Bucket, settings: Settings
) -> None:
    folder = open_store(settings)
    assert isinstance(folder, FolderStore)
    assert folder.root == settings.placewise_home / "objects"
    store = open_store(Settings(**s3.variables(bucket.name)))
    assert isinstance(store, S3Store)
    store.put("a", b"x")
    assert S3Store(bucket).get("a") == b"x"


def test_the_client_needs_its_settings(settings: Settings) -> None:
    with pytest.raises(Misconfigured, match="S3_ACCESS_KEY"):
        Bucket.from_settings(settings)


CLOCK_USE = """
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.storage.s3 import Bucket, S3Store
store = S3Store(Bucket.from_settings(Settings()))
for call in (store.check, lambda: store.put("a", b"x"), lambda: store.get("a")):
    try:
        call()
    except Unavailable as error:
        print(error.code, error.detail)
"""


def _use_with_wrong_clock(s3: S3Server, bucket: Bucket, seconds: int) -> list[str]:
    """Use the bucket by a clock that is off; return the errors."""
    variables = {name.upper(): str(value) for name, value in s3.variables(bucket.name).items()}
    used = subprocess.run(
        [sys.executable, "-c", CLOCK_USE],
        env={**os.environ, **variables, **clock_off_by(seconds)},
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return used.stdout.splitlines()


@pytest.mark.parametrize("seconds", [3600, -3600])
def test_a_clock_that_is_an_hour_off_is_named_as_the_reason(
    s3: S3Server, bucket: Bucket, seconds: int
) -> None:
    errors = _use_with_wrong_clock(s3, bucket, seconds)
    assert len(errors) == 3
    for error in errors:  # also of HEAD requests, whose responses have no body
        assert error.startswith("object_store_refused")
        assert "clocks" in error
        assert "S3_SECRET_KEY" not in error


@pytest.mark.parametrize("seconds", [600, -600])
def test_a_clock_that_is_ten_minutes_off_is_no_obstacle(
    s3: S3Server, bucket: Bucket, seconds: int
) -> None:
    assert _use_with_wrong_clock(s3, bucket, seconds) == []
    assert S3Store(bucket).get("a") == b"x"
