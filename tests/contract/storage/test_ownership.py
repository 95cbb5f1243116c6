"""One store for one catalog, and never a start with the objects out of reach."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from enum import StrEnum
from functools import partial
from pathlib import Path
from uuid import UUID

import pytest
from sqlalchemy import select

from shared.catalog.database.session import Catalog
from shared.catalog.installation import (
    adopt_store,
    check_before_new_catalog,
    get_or_create_installation,
    open_installation_store,
)
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id
from shared.storage import ObjectStore, OwnedStore
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner
from shared.storage.s3 import Bucket, S3Store
from tests.support.catalog_rows import add_map, upload
from tests.support.servers import S3Server
from tests.support.threads import at_once


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
        return open_installation_store(catalog, settings, exclusive=False)

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


def test_services_that_start_together_agree_on_the_bucket(
    started: Started, catalog: Catalog, bucket: Bucket
) -> None:
    at_once(*[partial(started, catalog, bucket)] * 4)


def test_a_bucket_with_foreign_objects_is_refused_and_unchanged(
    started: Started, catalog: Catalog, bucket: Bucket
) -> None:
    S3Store(bucket).put("thumbnails/theirs", b"x")
    refused(started, catalog, bucket, "bucket_taken")
    assert [info.key for info in S3Store(bucket).list("")] == ["thumbnails/theirs"]


def test_copy_of_the_whole_bucket_is_the_same_bucket_and_another_one_is_refused(
    started: Started, catalog: Catalog, bucket: Bucket, s3: S3Server, tmp_path: Path
) -> None:
    with catalog.write() as session:
        map_id = add_map(session).id
    upload(catalog, started(catalog, bucket), map_id, b"photo")
    refused(started, catalog, s3.new_bucket(), "object_store_changed")
    moved = s3.new_bucket()
    copied(bucket, moved)
    started(catalog, moved)
    refused(started, catalog, s3.new_bucket(), "object_store_changed")
    with pytest.raises(Misconfigured) as caught:
        open_installation_store(
            catalog, Settings(placewise_home=tmp_path / "home"), exclusive=False
        )
    assert caught.value.code == "object_store_changed"


# --- a folder, and what holds for both ---------------------------------------------------------


class Kind(StrEnum):
    FOLDER = "folder"
    BUCKET = "bucket"


@pytest.fixture(params=list(Kind))
def used(request: pytest.FixtureRequest, tmp_path: Path) -> Settings:
    """Settings with a store that was never used: a folder or a bucket."""
    home = tmp_path / "home"
    if request.param == Kind.FOLDER:
        return Settings(placewise_home=home)
    server: S3Server = request.getfixturevalue("s3")
    return Settings(placewise_home=home, **server.variables(server.new_bucket().name))


TAKEN = ("folder_taken", "bucket_taken")


def photo_of_before(catalog: Catalog, settings: Settings) -> OwnedStore:
    """The store as a release left it that marked no folder: with a photo of the catalog."""
    store = open_store(settings)
    with catalog.write() as session:
        map_id = add_map(session).id
    upload(catalog, store, map_id, b"photo")
    return store


def test_a_store_of_another_catalog_is_refused_with_the_remedies(
    used: Settings, catalog: Catalog, other_catalog: Catalog
) -> None:
    open_installation_store(catalog, used, exclusive=False).put("originals/a", b"x")
    with pytest.raises(Misconfigured) as caught:
        open_installation_store(other_catalog, used, exclusive=False)
    assert caught.value.code in TAKEN
    for way in ("Restore the catalog", "placewise storage rebuild"):
        assert way in caught.value.detail
    assert open_installation_store(catalog, used, exclusive=False).get("originals/a") == b"x"


def test_store_without_a_mark_is_marked_where_the_catalog_knows_its_photos(
    used: Settings, catalog: Catalog, other_catalog: Catalog
) -> None:
    store = photo_of_before(catalog, used)
    lost, _ = upload(catalog, store, _map_of(catalog), b"lost")
    with catalog.read() as session:
        store.delete(session.get_one(Photo, lost).object_key)  # one of them, by another fault
    assert read_owner(store) is None
    with pytest.raises(Misconfigured) as caught:
        open_installation_store(other_catalog, used, exclusive=False)
    assert caught.value.code in TAKEN
    assert read_owner(store) is None
    open_installation_store(catalog, used, exclusive=False)
    with catalog.write() as session:
        assert read_owner(store) == str(get_or_create_installation(session).id)


def _map_of(catalog: Catalog) -> UUID:
    with catalog.read() as session:
        return session.scalars(select(Map.id)).one()


def test_store_that_is_empty_or_of_strange_objects_is_refused_by_a_catalog_with_photos(
    used: Settings, catalog: Catalog, tmp_path: Path
) -> None:
    photo_of_before(catalog, Settings(placewise_home=tmp_path / "elsewhere"))
    with pytest.raises(Misconfigured, match="mounted") as caught:
        open_installation_store(catalog, used, exclusive=False)
    assert caught.value.code == "object_store_changed"
    open_store(used).put(f"originals/{new_id()}", b"of another one")
    with pytest.raises(Misconfigured) as caught:
        open_installation_store(catalog, used, exclusive=False)
    assert caught.value.code in TAKEN


def test_files_of_people_and_of_queries_do_not_keep_a_catalog_from_a_folder(
    catalog: Catalog, tmp_path: Path
) -> None:
    settings = Settings(placewise_home=tmp_path / "home", upload_dir=tmp_path / "photos")
    settings.placewise_home.mkdir()
    store = open_store(settings)
    for key in ("imports/city/1.jpg", "originals/holiday.jpg", f"queries/{new_id()}"):
        store.put(key, b"theirs")
    open_installation_store(catalog, settings, exclusive=False)


def test_two_catalogs_that_start_together_never_share_a_folder(
    catalog: Catalog, other_catalog: Catalog, tmp_path: Path
) -> None:
    settings = Settings(placewise_home=tmp_path / "home")

    def start(one: Catalog) -> str:
        try:
            open_installation_store(one, settings, exclusive=False)
        except Misconfigured as error:
            return error.code
        return "owner"

    outcomes = at_once(partial(start, catalog), partial(start, other_catalog))
    assert sorted(outcomes) == ["folder_taken", "owner"]


def test_new_catalog_is_not_even_created_beside_a_used_store(
    used: Settings, catalog: Catalog, tmp_path: Path
) -> None:
    new = Catalog(f"sqlite:///{tmp_path / 'new.sqlite'}")
    check_before_new_catalog(new, used)
    open_installation_store(catalog, used, exclusive=False)
    with pytest.raises(Misconfigured) as caught:
        check_before_new_catalog(new, used)
    assert caught.value.code in TAKEN
    assert not (tmp_path / "new.sqlite").exists()
    check_before_new_catalog(other := Catalog(str(catalog.url)), used)  # one that exists
    for opened in (new, other):
        opened.close()


def test_adopted_store_belongs_to_the_new_catalog_alone(
    used: Settings, catalog: Catalog, other_catalog: Catalog
) -> None:
    store = open_installation_store(catalog, used, exclusive=False)
    adopt_store(other_catalog, store)
    open_installation_store(other_catalog, used, exclusive=False)
    with pytest.raises(Misconfigured) as caught:
        open_installation_store(catalog, used, exclusive=False)
    assert caught.value.code in TAKEN
