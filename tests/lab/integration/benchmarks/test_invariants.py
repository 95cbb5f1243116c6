"""The fault suite's counts: each kind of damage is seen."""

from __future__ import annotations

from uuid import UUID

import pytest
from sqlalchemy import delete, update

from lab.benchmarks.invariants import InvariantViolations, check_invariants
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo
from shared.jobs import JobState
from shared.storage import FolderStore
from shared.storage.chunks import manifest_key
from tests.support.catalog_rows import add_chunk, add_generation, add_job, add_map, add_photo

Found = dict[str, UUID]


@pytest.fixture
def acknowledged(catalog: Catalog, store: FolderStore) -> Found:
    """Three photos, all is well."""
    with catalog.write() as session:
        map_id = add_map(session).id
        photos = [add_photo(session, map_id) for _ in range(3)]
        generation_id = add_generation(session, map_id).id
    for photo in photos:
        store.put(photo.object_key, b"its bytes")
    add_chunk(catalog, store, generation_id, [photo.id for photo in photos])
    return {photo.sha256: photo.id for photo in photos}


def changed(counts: InvariantViolations) -> dict[str, int]:
    names = ("lost", "twice", "stuck", "failed", "torn")
    return {name: getattr(counts, name) for name in names if getattr(counts, name)}


def test_nothing_is_counted_where_all_is_well(
    catalog: Catalog, store: FolderStore, acknowledged: Found
) -> None:
    counts = check_invariants(catalog, store, acknowledged)
    assert counts.none_found
    assert not counts.details


def test_a_photo_without_its_row_bytes_or_descriptor_is_lost(
    catalog: Catalog, store: FolderStore, acknowledged: Found
) -> None:
    first, second, third = acknowledged.values()
    with catalog.write() as session:
        photo = session.get_one(Photo, second)
        store.delete(photo.object_key)
        session.execute(delete(Descriptor).where(Descriptor.photo_id.in_([first, third])))
        session.execute(delete(Photo).where(Photo.id == first))
    counts = check_invariants(catalog, store, acknowledged)
    assert changed(counts) == {"lost": 3}
    assert [
        str(photo_id) in detail
        for photo_id, detail in zip((first, second, third), counts.details, strict=True)
    ] == [True] * 3


def test_bytes_that_are_stored_twice_are_counted(
    catalog: Catalog, store: FolderStore, acknowledged: Found
) -> None:
    sha256 = next(iter(acknowledged))
    with catalog.write() as session:
        other = add_map(session, "another")
        photo = add_photo(session, other.id, sha256=sha256)
    store.put(photo.object_key, b"its bytes")
    assert changed(check_invariants(catalog, store, acknowledged)) == {"twice": 1}


def test_unfinished_and_failed_jobs_are_counted(
    catalog: Catalog, store: FolderStore, acknowledged: Found
) -> None:
    with catalog.write() as session:
        map_id = session.get_one(Photo, next(iter(acknowledged.values()))).map_id
        add_job(session, map_id)
        add_job(session, map_id, state=JobState.RUNNING)
        add_job(session, map_id, state=JobState.FAILED, error={"code": "worker_crashed"})
    assert changed(check_invariants(catalog, store, acknowledged)) == {"stuck": 2, "failed": 1}


@pytest.mark.parametrize("damage", ["bytes", "no bytes", "no manifest", "another hash"])
def test_a_chunk_that_is_not_what_the_catalog_says_is_torn(
    catalog: Catalog, store: FolderStore, acknowledged: Found, damage: str
) -> None:
    with catalog.write() as session:
        chunk = session.query(Chunk).one()
        if damage == "another hash":
            session.execute(update(Chunk).values(sha256="0" * 64))
    if damage == "bytes":
        store.put(chunk.object_key, store.get(chunk.object_key)[:-1])
    elif damage == "no bytes":
        store.delete(chunk.object_key)
    elif damage == "no manifest":
        store.delete(manifest_key(chunk.object_key))
    assert changed(check_invariants(catalog, store, acknowledged)) == {"torn": 1}
