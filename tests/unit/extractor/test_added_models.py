"""The cache of added models: what is fetched is what was stored, and it does not grow for ever."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import pytest

from services.extractor.added_models import ModelFileCache
from shared.errors import NotFound, Unavailable
from shared.storage import FolderStore
from shared.storage.copying import STALE_PARTIAL_SECONDS


class Bucket(FolderStore):
    """A store whose objects are no files of this machine; it counts how often one is fetched."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.fetched = 0

    def file(self, key: str) -> Path | None:
        return None

    def open(self, key: str):  # type: ignore[no-untyped-def]
        self.fetched += 1
        return super().open(key)


@pytest.fixture
def bucket(tmp_path: Path) -> Bucket:
    return Bucket(tmp_path / "bucket")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def put(store: FolderStore, data: bytes) -> tuple[str, str]:
    """The object's key and hash."""
    sha256 = hashlib.sha256(data).hexdigest()
    store.put(f"models/{sha256}", data)
    return f"models/{sha256}", sha256


def test_a_model_is_fetched_once_and_read_from_the_folder_then(
    bucket: Bucket, folder: Path
) -> None:
    key, sha256 = put(bucket, b"weights")
    first = ModelFileCache(bucket, folder, 100).local_path(key, sha256)
    again = ModelFileCache(bucket, folder, 100).local_path(key, sha256)  # another process
    assert first == again
    assert first.read_bytes() == b"weights"
    assert bucket.fetched == 1


def test_models_of_a_folder_store_are_read_in_place(tmp_path: Path, folder: Path) -> None:
    store = FolderStore(tmp_path / "objects")
    key, sha256 = put(store, b"weights")
    assert ModelFileCache(store, folder, 100).local_path(key, sha256).read_bytes() == b"weights"
    assert not folder.exists()
    store.put(key, b"weightz")
    with pytest.raises(Unavailable) as caught:
        ModelFileCache(store, folder, 100).local_path(key, sha256)
    assert caught.value.code == "model_corrupt"


def test_a_cached_model_file_with_a_wrong_hash_is_fetched_again(
    bucket: Bucket, folder: Path
) -> None:
    key, sha256 = put(bucket, b"weights")
    cache = ModelFileCache(bucket, folder, 100)
    cache.local_path(key, sha256).write_bytes(b"wei")
    assert cache.local_path(key, sha256).read_bytes() == b"weights"
    assert bucket.fetched == 2


def test_a_file_with_a_wrong_hash_is_rejected_and_deleted(bucket: Bucket, folder: Path) -> None:
    key, sha256 = put(bucket, b"weights")
    bucket.put(key, b"others")
    with pytest.raises(Unavailable) as caught:
        ModelFileCache(bucket, folder, 100).local_path(key, sha256)
    assert caught.value.code == "model_corrupt"
    assert list(folder.iterdir()) == []
    bucket.delete(key)
    with pytest.raises(NotFound):
        ModelFileCache(bucket, folder, 100).local_path(key, sha256)


def test_the_least_recently_used_model_is_evicted_from_the_cache(
    bucket: Bucket, folder: Path
) -> None:
    cache = ModelFileCache(bucket, folder, 25)
    stored = [put(bucket, bytes([number]) * 10) for number in range(4)]
    paths = [cache.local_path(*one) for one in stored[:3]]  # two fit beside the one that is fetched
    for age, path in zip((300, 200, 100), paths, strict=True):
        os.utime(path, (time.time() - age, time.time() - age))
    cache.local_path(*stored[0])  # used just now
    left_over = folder / "killed.partial"
    left_over.write_bytes(b"half")
    os.utime(left_over, (time.time() - STALE_PARTIAL_SECONDS - 1,) * 2)
    newest = cache.local_path(*stored[3])
    assert set(folder.iterdir()) == {paths[0], paths[2], newest}


def test_a_model_larger_than_the_cache_is_used_all_the_same(bucket: Bucket, folder: Path) -> None:
    cache = ModelFileCache(bucket, folder, 0)
    for number in range(2):
        path = cache.local_path(*put(bucket, bytes([number]) * 10))
        assert path.read_bytes() == bytes([number]) * 10
        assert list(folder.iterdir()) == [path]
