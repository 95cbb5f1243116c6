"""Storing a photo and its job, on SQLite and on PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from uuid import UUID

import pytest
from sqlalchemy import event, func, select
from sqlalchemy.orm import Session

from shared.catalog.database.session import Catalog
from shared.catalog.jobs import Job, JobState
from shared.catalog.maps import Map, mark_map_deleted
from shared.catalog.photos import Photo, find_same_photo
from shared.errors import NotFound
from shared.imaging.photo_header import PhotoHeader
from shared.ingest import store_photo as store_photo_module
from shared.ingest.photo_metadata import PhotoFields
from shared.ingest.store_photo import StoreResult, insert_photo
from shared.ingest.validation import StoredUpload, ValidatedPhoto
from tests.support.catalog_rows import add_map
from tests.support.threads import at_once

NAME = "of the photo"


@pytest.fixture
def map_id(catalog: Catalog) -> UUID:
    with catalog.write() as session:
        return add_map(session, NAME).id


def photo(
    number: int = 0,
    key: str = "originals/a",
    picture: str | None = None,
    header: PhotoHeader | None = None,
) -> ValidatedPhoto:
    received = StoredUpload(key, "a.jpg", 1000, f"{number:064x}", b"")
    header = header or PhotoHeader(640, 480)
    fields = PhotoFields(place="hall", tags=["day"])
    return ValidatedPhoto(received, "image/jpeg", header, fields, picture_sha256=picture)


def finish(catalog: Catalog, stored: StoreResult) -> None:
    assert stored.job is not None
    with catalog.write() as session:
        session.get_one(Job, stored.job.id).state = JobState.SUCCEEDED


def store(catalog: Catalog, incoming: ValidatedPhoto) -> StoreResult:
    with catalog.write() as session:
        return insert_photo(session, NAME, incoming)


@contextmanager
def counted_statements(catalog: Catalog) -> Iterator[list[str]]:
    statements: list[str] = []

    def count(_c: object, _cursor: object, statement: str, *_: object) -> None:
        statements.append(statement)

    event.listen(catalog.engine, "before_cursor_execute", count)
    try:
        yield statements
    finally:
        event.remove(catalog.engine, "before_cursor_execute", count)


def test_a_new_photo_takes_two_statements_beside_those_of_the_transaction(
    catalog: Catalog, map_id: UUID
) -> None:
    store(catalog, photo(1))
    with counted_statements(catalog) as statements:
        store(catalog, photo(2))
    of_rows = [s.split()[:3] for s in statements if not s.startswith(("BEGIN", "PRAGMA"))]
    assert of_rows == [["INSERT", "INTO", "photos"], ["INSERT", "INTO", "jobs"]]


def test_the_returned_rows_are_those_of_the_catalog(catalog: Catalog, map_id: UUID) -> None:
    stored = store(catalog, photo())
    assert stored.job is not None
    with catalog.read() as session:
        in_catalog = session.get_one(Photo, stored.photo.id)
        job = session.get_one(Job, stored.job.id)
        for name, value in vars(stored.photo).items():
            assert name.startswith("_") or getattr(in_catalog, name) == value, name
        for name, value in vars(stored.job).items():
            assert name.startswith("_") or getattr(job, name) == value, name
        assert (in_catalog.revision, in_catalog.journaled_revision) == (1, 0)
        assert in_catalog.map_id == map_id
        assert (job.state, job.params, job.attempts) == (JobState.QUEUED, {}, 0)


def test_the_same_bytes_by_several_at_once_are_stored_once(catalog: Catalog, map_id: UUID) -> None:
    sent = [photo(key=f"originals/{number}") for number in range(4)]
    results = at_once(*(partial(store, catalog, each) for each in sent))
    assert len({result.photo.id for result in results}) == 1
    assert sum(result.queued for result in results) == 1
    with catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Photo)) == 1
        assert session.scalar(select(func.count()).select_from(Job)) == 1


def test_a_photo_whose_twin_is_deleted_between_insert_and_lookup_is_stored(
    catalog: Catalog, map_id: UUID, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = store(catalog, photo())

    def delete_then_find(session: Session, *arguments: object) -> Photo | None:
        session.get_one(Photo, first.photo.id).deleted_at = first.photo.uploaded_at
        session.flush()
        return find_same_photo(session, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(store_photo_module, "find_same_photo", delete_then_find)
    second = store(catalog, photo())
    assert second.queued
    assert second.photo.id != first.photo.id


LOCATED = PhotoHeader(640, 480, latitude=45.07, longitude=7.68)


def test_a_file_of_the_same_picture_with_new_coordinates_updates_the_photo(
    catalog: Catalog, map_id: UUID
) -> None:
    first = store(catalog, photo(1, "originals/1", "same"))
    finish(catalog, first)
    stripped = store(catalog, photo(3, "originals/3", "same"))
    assert (stripped.photo.id, stripped.updated) == (first.photo.id, ())
    assert stripped.unused_key == "originals/3", "a file with less metadata replaces nothing"
    second = store(catalog, photo(2, "originals/2", "same", LOCATED))
    assert (second.photo.id, second.already_there) == (first.photo.id, True)
    assert (second.updated, second.unused_key) == (("latitude", "longitude"), "originals/1")
    with catalog.read() as session:
        [found] = session.scalars(select(Photo))
        assert (found.latitude, found.object_key) == (45.07, "originals/2")
        assert found.changed_version == session.get_one(Map, map_id).version
    again = store(catalog, photo(2, "originals/4", "same", LOCATED))
    assert (again.updated, again.unused_key) == ((), "originals/4")
    assert not store(catalog, photo(5, "originals/5", "another", LOCATED)).already_there


def test_the_file_of_a_photo_that_is_being_described_is_not_replaced(
    catalog: Catalog, map_id: UUID
) -> None:
    store(catalog, photo(1, "originals/1", "same"))
    second = store(catalog, photo(2, "originals/2", "same", LOCATED))
    assert (second.updated, second.unused_key) == (("latitude", "longitude"), "originals/2")
    with catalog.read() as session:
        [found] = session.scalars(select(Photo))
        assert (found.latitude, found.object_key) == (45.07, "originals/1")


def test_a_map_that_does_not_exist_or_is_deleted_is_not_found(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        mark_map_deleted(session, session.get_one(Map, map_id))
    for name in (NAME, f"deleted/{map_id}"):
        with pytest.raises(NotFound) as caught, catalog.write() as session:
            insert_photo(session, name, photo())
        assert caught.value.code == "map_not_found"
