"""A lost catalog is rebuilt from its store, and an older one takes in what it lacks."""

from __future__ import annotations

import contextlib
import json
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from sqlalchemy import delete, func, insert, select

from services.steward.tasks import journal
from services.steward.tasks.compaction import merge_small_chunks
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.garbage_collection import collect_deleted_photos
from services.steward.tasks.model_changes import advance_model_changes
from services.steward.tasks.orphans import CollectionHeld, collect_orphans
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.base import Base
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.installation import Installation, get_or_create_installation
from shared.catalog.jobs import Job
from shared.catalog.maps import Map, get_or_create_default_map
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Conflict, StorageFull
from shared.ids import new_id
from shared.integrity.verify import verify_store
from shared.jobs import InProcessWakeups
from shared.journal.outbox import catalog_lag, write_journal
from shared.journal.segments import list_segments
from shared.rebuild import recover
from shared.rebuild.recover import RecoveryReport, begin_rebuild, recover_catalog
from shared.storage import FolderStore
from shared.storage.chunks import manifest_key, write_chunk
from shared.storage.keys import JOURNAL, ORIGINALS
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import stored_rows
from tests.support.photos import photo_bytes

# tests/faults/test_rebuild_catalog.py does the same on SQLite.
pytestmark = pytest.mark.databases("postgresql")

VLAD = "test-tiny-vlad"
POOLED = "test-tiny-vlad:aggregator=gem"

SAID: dict[str, Any] = {
    "latitude": 45.5,
    "longitude": 7.25,
    "heading": 90,
    "captured_at": "2026-05-01T12:30:00+00:00",
    "place": "tower",
    "tags": "night,rain",
    "metadata": '{"camera": {"id": 7}}',
}


def lose_catalog(catalog: Catalog) -> None:
    """Every row is gone, as from a database that is made anew."""
    with catalog.write() as session:
        for table in reversed(Base.metadata.sorted_tables):
            session.execute(delete(table))


def rebuilt(service: Service) -> tuple[Service, RecoveryReport]:
    """Services on the rebuilt catalog."""
    begin_rebuild(service.catalog, service.store)
    taken = recover_catalog(service.catalog, service.store, service.settings, unnamed_age_seconds=0)
    return Service(service.catalog, service.store, service.settings, service.make_worker), taken


def photo(service: Service, file_id: str, map_name: str = "default") -> Any:
    """What the API says of the photo, but for its job, which a rebuilt catalog does not know."""
    return service.json("GET", f"/uploads/{file_id}", params={"map": map_name}) | {"job_id": None}


def answers(service: Service, file_id: str, map_name: str = "default") -> Any:
    service.search.sync()
    found = service.json("POST", f"/similarity/{file_id}", params={"map": map_name})
    return found["similar_images"]


def two_maps(service: Service) -> dict[str, str]:
    """Photos of two maps of two extractors, a labelled query, one that was patched and one that was
    deleted: the map of each that is left."""
    service.json("POST", "/maps", 201, json={"name": "halls", "extractor": "test-tiny-vlad"})
    first, second, gone = service.indexed(1, 2, 3, **SAID)
    nowhere = {"place": "bridge", "latitude": None, "longitude": None}
    service.json("PATCH", f"/uploads/{second}", json=nowhere)
    (query,) = service.indexed(4, role="query", place="tower")
    halls = [service.upload(photo_bytes(n), "halls")["file_id"] for n in (1, 5, 6)]
    service.json("POST", "/vocabularies", 202, params={"map": "halls"}, json={"clusters": 4})
    for _ in range(20):
        service.drain()
        advance_model_changes(service.catalog, InProcessWakeups())
    service.json("DELETE", f"/uploads/{gone}")
    return dict.fromkeys((first, second, query), "default") | dict.fromkeys(halls, "halls")


@pytest.mark.databases("sqlite", "postgresql")
def test_every_photo_is_searchable_again_with_its_metadata(
    service: Service,
    store: FolderStore,
    settings: Settings,
) -> None:
    left = two_maps(service)
    service.json("POST", "/maps", 201, json={"name": "gone"})
    service.indexed(9, map_name="gone")
    service.json("DELETE", "/maps/gone")
    write_journal(service.catalog, store)
    with service.catalog.write() as session:
        installation_id = get_or_create_installation(session).id
    fields = {file_id: photo(service, file_id, name) for file_id, name in left.items()}
    before = {file_id: answers(service, file_id, name) for file_id, name in left.items()}
    assert all(before.values())

    lose_catalog(service.catalog)
    with service.catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)  # as a first start has left it
    service, taken = rebuilt(service)
    assert (taken.maps, taken.photos, taken.queued_photos) == (2, 6, 0)
    assert taken.descriptors == 6
    assert taken.unnamed_photos == taken.lost_originals == 0
    assert {file_id: photo(service, file_id, name) for file_id, name in left.items()} == fields
    assert {file_id: answers(service, file_id, name) for file_id, name in left.items()} == before
    with service.catalog.read() as session:
        assert session.scalars(select(Installation.id)).one() == installation_id
        assert session.scalar(select(func.count()).select_from(Photo)) == 6
    assert verify_store(service.catalog, store, originals=True).faults == []
    assert catalog_lag(service.catalog, store) is None
    assert [m["name"] for m in service.json("GET", "/maps")] == ["default", "halls"]
    # It goes on: new photos come into the same generations, and the journal too.
    (new,) = service.indexed(7, map_name="halls")
    assert answers(service, new, "halls")
    assert write_journal(service.catalog, store).lines > 0
    assert collect_orphans(service.catalog, store, -1.0) > 0  # the deleted photo's and map's
    assert verify_store(service.catalog, store, originals=True).faults == []


def test_a_map_with_float16_rows_goes_on_with_them(service: Service, store: FolderStore) -> None:
    service.json("POST", "/maps", 201, json={"name": "half", "rows": "float16"})
    photos = service.indexed(1, 2, 3, map_name="half")
    before = [answers(service, photo_id, "half") for photo_id in photos]
    write_journal(service.catalog, store)
    lose_catalog(service.catalog)
    service, _ = rebuilt(service)
    assert [answers(service, photo_id, "half") for photo_id in photos] == before
    service.indexed(4, map_name="half")
    (generation,) = service.json("GET", "/generations", params={"map": "half"})
    assert generation["rows"] == "float16"
    rows = stored_rows(service.catalog, store, UUID(generation["generation_id"]))
    assert [row.dtype for row in rows.values()] == 4 * [np.dtype(np.float16)]


def test_a_rebuild_that_was_killed_goes_on_and_a_full_catalog_is_refused(
    service: Service,
    store: FolderStore,
    settings: Settings,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    service.indexed(1, 2, 3, **SAID)
    write_journal(service.catalog, store)

    lose_catalog(service.catalog)

    def die(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    for step in ("recover_chunks", "recover_originals", "_queue_photos"):
        with monkeypatch.context() as patched:
            patched.setattr(recover, step, die)
            with pytest.raises(KeyboardInterrupt):
                rebuilt(service)
        lag = catalog_lag(service.catalog, store)
        assert lag is not None
        assert "storage rebuild" in lag.detail
        with contextlib.suppress(CollectionHeld):
            assert collect_orphans(service.catalog, store, -1.0) == 0
        assert write_journal(service.catalog, store).lines == 0
    rebuilt(service)
    with service.catalog.read() as session:
        for table, rows in ((Photo, 3), (Descriptor, 3), (Chunk, 1), (Job, 0)):
            assert session.scalar(select(func.count()).select_from(table)) == rows, table
    assert verify_store(service.catalog, store, originals=True).faults == []
    with pytest.raises(Conflict, match="photos") as caught:
        begin_rebuild(service.catalog, store)
    assert caught.value.code == "catalog_not_empty"


@pytest.mark.parametrize("lost", ["chunk", "changed chunk", "manifest"])
def test_photos_of_chunks_that_are_lost_are_described_again(
    service: Service,
    store: FolderStore,
    settings: Settings,
    lost: str,
) -> None:
    first, second = service.indexed(1, 2)
    before = answers(service, first)
    write_journal(service.catalog, store)
    with service.catalog.read() as session:
        (key,) = session.scalars(select(Chunk.object_key))
    if lost == "changed chunk":
        store.put(key, store.get(key)[:-1] + b"x")
    else:
        store.delete(key if lost == "chunk" else manifest_key(key))
    lose_catalog(service.catalog)
    service, taken = rebuilt(service)
    assert (taken.photos, taken.descriptors, taken.queued_photos) == (2, 0, 2)
    assert taken.damaged_chunks == ([] if lost == "chunk" else [key])
    service.drain()
    assert (
        [one["image_id"] for one in answers(service, first)] == [before[0]["image_id"]] == [second]
    )


def test_merged_chunks_give_each_photo_one_row(
    service: Service, store: FolderStore, settings: Settings
) -> None:
    file_ids = [service.indexed(number)[0] for number in (1, 2, 3)]
    assert (
        merge_small_chunks(service.catalog, store, compact_chunks=2) == 1
    )  # the three lie there still
    file_ids += service.indexed(4)
    write_journal(service.catalog, store)
    lose_catalog(service.catalog)
    service, taken = rebuilt(service)
    assert (taken.chunks, taken.descriptors) == (2, 4)
    with service.catalog.read() as session:
        assert set(session.scalars(select(Descriptor.photo_id))) == set(map(UUID, file_ids))
    assert verify_store(service.catalog, store, originals=True).faults == []


def test_uploads_of_the_last_seconds_come_back_though_the_journal_does_not_name_them(
    service: Service,
    store: FolderStore,
    settings: Settings,
) -> None:
    (known,) = service.indexed(1, place="tower")
    write_journal(service.catalog, store)
    service.indexed(2, place="lost")
    store.put(f"{ORIGINALS}{uuid4()}", photo_bytes(1))  # an upload of known bytes that was killed
    store.put(f"{ORIGINALS}{uuid4()}", b"no photo")
    lose_catalog(service.catalog)
    service, taken = rebuilt(service)
    assert (taken.photos, taken.unnamed_photos, taken.queued_photos) == (1, 1, 1)
    assert len(taken.unreadable_originals) == 1
    service.drain()
    (found,) = answers(service, known)
    assert photo(service, found["image_id"])["place"] is None


def test_a_home_of_before_the_journal_comes_back_with_what_exif_says(
    service: Service,
    store: FolderStore,
    settings: Settings,
) -> None:
    service.indexed(1, 2, place="lost")
    with service.catalog.read() as session:
        where = [(p.sha256, p.latitude, p.captured_at) for p in session.scalars(select(Photo))]
    lose_catalog(service.catalog)
    service, taken = rebuilt(service)
    assert (taken.photos, taken.unnamed_photos, taken.queued_photos) == (0, 2, 2)
    assert taken.unnamed_descriptors == 2
    with service.catalog.read() as session:
        found = [(p.sha256, p.latitude, p.captured_at) for p in session.scalars(select(Photo))]
    assert sorted(found) == sorted(where)
    service.drain()
    with service.catalog.read() as session:
        first = str(session.scalars(select(Photo.id)).first())
    assert len(answers(service, first)) == 1


@pytest.mark.parametrize(("pools", "recovered"), [(True, VLAD), (False, POOLED)])
def test_a_map_that_began_pooled_comes_back_with_the_extractor_that_waits_for_a_vocabulary(
    catalog: Catalog, store: FolderStore, settings: Settings, pools: bool, recovered: str
) -> None:
    started = settings.model_copy(update={"extractor": VLAD, "pool_without_vocabulary": pools})
    store.put(f"{ORIGINALS}{uuid4()}", photo_bytes(1))
    chunk_id = new_id()
    write_chunk(
        store,
        generation_id=new_id(),
        chunk_id=chunk_id,
        rows=np.eye(1, 4, dtype=np.float32),
        photo_ids=[new_id()],
        spec={"extractor": POOLED},
    )
    recover_catalog(catalog, store, started, unnamed_age_seconds=0)
    with catalog.read() as session:
        assert session.scalars(select(Map.extractor)).one() == recovered


def test_a_photo_whose_original_is_gone_stays_away(
    service: Service, store: FolderStore, settings: Settings
) -> None:
    first, _ = service.indexed(1, 2)
    write_journal(service.catalog, store)
    with service.catalog.read() as session:
        store.delete(session.get_one(Photo, UUID(first)).object_key)
    lose_catalog(service.catalog)
    service, taken = rebuilt(service)
    assert (taken.photos, taken.lost_originals, taken.descriptors) == (1, 1, 1)


# --- an older catalog ------------------------------------------------------------------------


def put_back(catalog: Catalog, rows: dict[str, list[dict[str, Any]]]) -> None:
    """The rows of before, as if their database had been copied and put back."""
    with catalog.write() as session:
        for table in reversed(Base.metadata.sorted_tables):
            session.execute(delete(table))
        for table in Base.metadata.sorted_tables:
            if rows[table.name]:
                session.connection().execute(insert(table), rows[table.name])


def copied(catalog: Catalog) -> dict[str, list[dict[str, Any]]]:
    with catalog.read() as session:
        return {
            table.name: [dict(row) for row in session.execute(select(table)).mappings()]
            for table in Base.metadata.sorted_tables
        }


def test_an_older_catalog_collects_nothing_and_takes_in_what_came_later(
    service: Service, store: FolderStore, settings: Settings
) -> None:
    first, second = service.indexed(1, 2, **SAID)
    write_journal(service.catalog, store)
    older = copied(service.catalog)
    (later,) = service.indexed(3, **SAID)
    service.json("PATCH", f"/uploads/{first}", json={"place": "bridge"})
    service.json("DELETE", f"/uploads/{second}")
    service.json("POST", "/maps", 201, json={"name": "later"})
    (elsewhere,) = service.indexed(4, map_name="later")
    write_journal(service.catalog, store)
    fields = {later: photo(service, later), first: photo(service, first)}
    before = {info.key for info in store.list("")}

    put_back(service.catalog, older)
    with pytest.raises(CollectionHeld):
        collect_orphans(service.catalog, store, -1.0)
    assert {info.key for info in store.list("")} == before
    lag = catalog_lag(service.catalog, store)
    assert lag is not None
    assert lag.segments >= 1
    assert write_journal(service.catalog, store).lines == 0

    taken = recover_catalog(service.catalog, store, settings, unnamed_age_seconds=3600)
    assert (taken.maps, taken.photos, taken.deleted_photos) == (1, 2, 1)
    assert taken.changed_photos == 1
    assert catalog_lag(service.catalog, store) is None
    service.drain()
    assert {id_: photo(service, id_) for id_ in fields} == fields
    assert [one["image_id"] for one in answers(service, first)] == [later]
    assert photo(service, elsewhere, "later")["searchable"]
    assert service("GET", f"/uploads/{second}").status_code == 404
    assert verify_store(service.catalog, store, originals=True).faults == []
    assert (
        recover_catalog(service.catalog, store, settings, unnamed_age_seconds=3600)
        == RecoveryReport()
    )


def test_bytes_are_deleted_once_the_journal_has_the_deletion(
    service: Service, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.json("POST", "/maps", 201, json={"name": "other"})
    photos = service.indexed(1)
    service.indexed(2, map_name="other")
    write_journal(service.catalog, store)
    service.json("DELETE", f"/uploads/{photos[0]}")
    service.json("DELETE", "/maps/other")

    def full(*_: Any) -> Any:
        raise StorageFull("disk_full", "The disk is full.")

    def round_() -> int:
        collect_deleted_photos(service.catalog, store, 0)
        purge_deleted_maps(service.catalog, store)
        return len(list(store.list(ORIGINALS)))

    with monkeypatch.context() as patched:
        patched.setattr(journal, "write_journal", full)
        assert round_() == 2
        patched.setattr(journal, "MAX_JOURNAL_WAIT_SECONDS", -1.0)
        assert round_() == 0, "only deleting makes room in a full store"
        with service.catalog.read() as session:
            assert session.get(Photo, UUID(photos[0])) is not None, "the journal is written later"
    assert round_() == 0
    text = json.dumps([info.key for info in store.list(JOURNAL)])
    assert len(list_segments(store)) == 2, text
    with service.catalog.read() as session:
        assert session.get(Photo, UUID(photos[0])) is None
        assert session.scalar(select(func.count()).select_from(Generation)) == 1
