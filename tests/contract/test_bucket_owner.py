"""One bucket for one home, and never a start with the objects out of reach."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.errors import Misconfigured
from shared.objects.bucket_owner import claim_bucket
from shared.objects.folder import FolderStore
from shared.objects.open_store import open_store
from shared.objects.s3 import Bucket, S3Store
from shared.settings import Settings
from tests.support.servers import S3Server


@pytest.fixture
def bucket(s3: S3Server) -> Bucket:
    return s3.new_bucket()


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "home").mkdir()
    return tmp_path / "home"


def refused(home: Path, bucket: Bucket, code: str) -> str:
    with pytest.raises(Misconfigured) as caught:
        claim_bucket(home, S3Store(bucket))
    assert caught.value.code == code
    return caught.value.detail


def test_empty_bucket_is_taken_and_taken_again_at_the_next_start(
    home: Path, bucket: Bucket
) -> None:
    claim_bucket(home, S3Store(bucket))
    S3Store(bucket).put("originals/a", b"x")
    claim_bucket(home, S3Store(bucket))


def test_bucket_of_another_home_is_refused(home: Path, bucket: Bucket, tmp_path: Path) -> None:
    claim_bucket(home, S3Store(bucket))
    (tmp_path / "another").mkdir()
    assert bucket.name in refused(tmp_path / "another", bucket, "bucket_taken")


def test_bucket_with_other_things_in_it_is_refused_and_left_alone(
    home: Path, bucket: Bucket
) -> None:
    S3Store(bucket).put("thumbnails/theirs", b"x")
    refused(home, bucket, "bucket_taken")
    assert [info.key for info in S3Store(bucket).list("")] == ["thumbnails/theirs"]


def test_another_bucket_than_the_one_of_before_is_refused(
    home: Path, bucket: Bucket, s3: S3Server
) -> None:
    claim_bucket(home, S3Store(bucket))
    assert bucket.name in refused(home, s3.new_bucket(), "object_store_changed")


def test_copy_of_the_whole_bucket_is_the_same_bucket(
    home: Path, bucket: Bucket, s3: S3Server
) -> None:
    claim_bucket(home, S3Store(bucket))
    moved = s3.new_bucket()
    for info in S3Store(bucket).list(""):
        S3Store(moved).put(info.key, S3Store(bucket).get(info.key))
    claim_bucket(home, S3Store(moved))
    refused(home, s3.new_bucket(), "object_store_changed")


def test_home_with_objects_in_its_folder_takes_no_bucket(home: Path, bucket: Bucket) -> None:
    store = FolderStore(home / "objects")
    half = store.writer("originals/half")
    half.write(b"no object yet")
    store.put("originals/a", b"x")
    refused(home, bucket, "object_store_changed")
    store.delete("originals/a")
    assert list((home / "objects" / ".partial").iterdir())
    claim_bucket(home, S3Store(bucket))
    half.abort()


def test_home_with_objects_in_a_bucket_takes_no_folder(home: Path, bucket: Bucket) -> None:
    claim_bucket(home, S3Store(bucket))
    with pytest.raises(Misconfigured) as caught:
        open_store(Settings(placewise_home=home))
    assert caught.value.code == "object_store_changed"
    assert bucket.name in caught.value.detail
