"""The embedded Placewise with its objects in a bucket of a real S3 server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.storage.s3 import Bucket, S3Store
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess, environment, run_command
from tests.support.servers import S3Server
from tests.support.waiting import wait_until

GONE_SECONDS = 30.0  # the steward's round, and some


@pytest.fixture(scope="module")
def bucket(s3: S3Server) -> Bucket:
    return s3.new_bucket()


@pytest.fixture(scope="module")
def server(
    s3: S3Server, bucket: Bucket, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ServerProcess]:
    home = tmp_path_factory.mktemp("server") / "home"
    with ServerProcess(home, **s3.variables(bucket.name)) as started:
        yield started


def keys(bucket: Bucket, prefix: str) -> set[str]:
    return {info.key for info in S3Store(bucket).list(prefix)}


def test_photos_are_described_found_and_deleted_in_the_bucket(
    server: ServerProcess, bucket: Bucket
) -> None:
    photos = [server.indexed(photo_bytes(number), f"{number}.jpg") for number in range(3)]
    assert len(keys(bucket, "originals/")) == 3
    assert keys(bucket, "chunks/")
    assert not [path for path in (server.home / "objects").rglob("*") if path.is_file()]

    found = server.similar(photos[0]).json()["similar_images"]
    assert {photo["image_id"] for photo in found} == set(photos[1:])
    found = server.ask(photo_bytes(1)).json()["similar_images"]
    assert found[0]["image_id"] == photos[1]
    image = server.client.get(f"/api/v1/uploads/{photos[2]}/image")
    assert image.content == photo_bytes(2)
    assert server.client.get(f"/api/v1/uploads/{photos[2]}/thumbnail").status_code == 200

    thumbnail = f"thumbnails/{photos[2]}.jpg"
    assert thumbnail in keys(bucket, "thumbnails/")
    before = keys(bucket, "originals/")
    assert server.client.delete(f"/api/v1/uploads/{photos[2]}?permanently=true").is_success
    wait_until(lambda: len(keys(bucket, "originals/")) < 3, GONE_SECONDS)
    wait_until(lambda: thumbnail not in keys(bucket, "thumbnails/"), GONE_SECONDS)
    assert keys(bucket, "originals/") < before
    assert S3Store(bucket).head(thumbnail) is None


def test_what_is_in_the_bucket_is_there_at_the_next_start(server: ServerProcess) -> None:
    photo = server.indexed(photo_bytes(10), "new.jpg")
    server.kill()
    server.start()
    assert server.client.get(f"/api/v1/uploads/{photo}/image").content == photo_bytes(10)
    found = server.ask(photo_bytes(10)).json()["similar_images"]
    assert found[0]["image_id"] == photo


def test_placewise_does_not_start_without_its_object_store(tmp_path: Path) -> None:
    nobody = S3Server("127.0.0.1:1", "someone", "a secret", False, None)
    ended = run_command(
        "serve", env=environment(tmp_path / "home", **nobody.variables("placewise")), cwd=tmp_path
    )
    assert ended.returncode == 1, ended.stderr
    errors = [line for line in ended.stderr.splitlines() if "object_store_unavailable: " in line]
    assert errors, ended.stderr
    assert nobody.endpoint in errors[0]
    assert "Traceback" not in ended.stderr
