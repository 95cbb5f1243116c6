"""One bucket for one catalog, and never a start with the objects out of reach."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import select

from shared.catalog.installation import Installation, ensure_installation, open_own_store
from shared.catalog.session import Catalog
from shared.errors import Misconfigured
from shared.objects import ObjectStore
from shared.objects.folder import MARK, FolderStore
from shared.objects.s3 import Bucket, S3Store
from shared.settings import Settings
from tests.support.servers import PostgresServer, S3Server


@pytest.fixture
def bucket(s3: S3Server) -> Bucket:
    return s3.new_bucket()


@pytest.fixture
def other_catalog(migrated_sqlite: Path, tmp_path: Path) -> Iterator[Catalog]:
    copy = shutil.copy(migrated_sqlite, tmp_path / "other.sqlite")
    opened = Catalog(f"sqlite:///{copy}")
    yield opened
    opened.close()


@pytest.fixture
def started(s3: S3Server, tmp_path: Path) -> Callable[[Catalog, Bucket], ObjectStore]:
    """What each service does at its start."""

    def start(catalog: Catalog, bucket: Bucket) -> ObjectStore:
        settings = Settings(placewise_home=tmp_path / "home", **s3.variables(bucket.name))
        return open_own_store(catalog, settings, alone=False)

    return start


Started = Callable[[Catalog, Bucket], ObjectStore]


def refused(started: Started, catalog: Catalog, bucket: Bucket, code: str) -> str:
    with pytest.raises(Misconfigured) as caught:
        started(catalog, bucket)
    assert caught.value.code == code
    return caught.value.detail


def copied(source: Bucket, target: Bucket) -> None:
    for info in S3Store(source).list(""):
        S3Store(target).put(info.key, S3Store(source).get(info.key))


def test_an_installation_has_one_id_for_ever(catalog: Catalog) -> None:
    with catalog.write() as session:
        first = ensure_installation(session).id
    with catalog.write() as session:
        assert ensure_installation(session).id == first
        assert len(session.scalars(select(Installation)).all()) == 1


def test_two_catalogs_have_two_ids(catalog: Catalog, other_catalog: Catalog) -> None:
    ids = set()
    for one in (catalog, other_catalog):
        with one.write() as session:
            ids.add(ensure_installation(session).id)
    assert len(ids) == 2


def test_empty_bucket_is_taken_and_taken_again_at_the_next_start(
    started: Started, catalog: Catalog, bucket: Bucket
) -> None:
    started(catalog, bucket).put("originals/a", b"x")
    started(catalog, bucket)
    with catalog.read() as session:
        owner = ensure_installation(session).id
    assert S3Store(bucket).get(MARK).decode() == str(owner)


def test_services_that_start_together_agree_on_the_bucket(
    started: Started, catalog: Catalog, bucket: Bucket
) -> None:
    opened: list[ObjectStore] = []
    threads = [
        threading.Thread(target=lambda: opened.append(started(catalog, bucket))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(opened) == 4


def test_bucket_of_another_catalog_is_refused(
    started: Started, catalog: Catalog, other_catalog: Catalog, bucket: Bucket
) -> None:
    started(catalog, bucket)
    said = refused(started, other_catalog, bucket, "bucket_taken")
    assert bucket.name in said
    assert "DATABASE_URL" in said


def test_bucket_with_other_things_in_it_is_refused_and_left_alone(
    started: Started, catalog: Catalog, bucket: Bucket
) -> None:
    S3Store(bucket).put("thumbnails/theirs", b"x")
    refused(started, catalog, bucket, "bucket_taken")
    assert [info.key for info in S3Store(bucket).list("")] == ["thumbnails/theirs"]


def test_another_bucket_than_the_one_of_before_is_refused(
    started: Started, catalog: Catalog, bucket: Bucket, s3: S3Server
) -> None:
    started(catalog, bucket)
    assert bucket.name in refused(started, catalog, s3.new_bucket(), "object_store_changed")


def test_copy_of_the_whole_bucket_is_the_same_bucket(
    started: Started, catalog: Catalog, bucket: Bucket, s3: S3Server
) -> None:
    started(catalog, bucket)
    moved = s3.new_bucket()
    copied(bucket, moved)
    started(catalog, moved)
    refused(started, catalog, s3.new_bucket(), "object_store_changed")


def test_restored_backup_of_the_catalog_keeps_its_bucket(
    started: Started, postgres: PostgresServer, migrated_postgres: str, bucket: Bucket
) -> None:
    url = postgres.new_database(migrated_postgres)
    before = Catalog(url)
    started(before, bucket).put("originals/a", b"x")
    before.close()
    restored = Catalog(postgres.new_database(url.rsplit("/", 1)[1]))
    assert started(restored, bucket).get("originals/a") == b"x"
    restored.close()


def test_home_with_objects_in_its_folder_takes_no_bucket(
    started: Started, catalog: Catalog, bucket: Bucket, tmp_path: Path
) -> None:
    store = FolderStore(tmp_path / "home" / "objects")
    half = store.writer("originals/half")
    half.write(b"no object yet")
    store.put("originals/a", b"x")
    refused(started, catalog, bucket, "object_store_changed")
    store.delete("originals/a")
    assert list((tmp_path / "home" / "objects" / ".partial").iterdir())
    started(catalog, bucket)
    half.abort()


def test_catalog_with_objects_in_a_bucket_takes_no_folder(
    started: Started, catalog: Catalog, bucket: Bucket, tmp_path: Path
) -> None:
    started(catalog, bucket)
    with pytest.raises(Misconfigured) as caught:
        open_own_store(catalog, Settings(placewise_home=tmp_path / "home"), alone=False)
    assert caught.value.code == "object_store_changed"
    assert bucket.name in caught.value.detail
