"""A lost catalog is rebuilt from its store."""

from __future__ import annotations

import json
import threading
from datetime import timedelta
from functools import partial
from typing import Any
from uuid import UUID, uuid4

import pytest
from sqlalchemy import delete, func, select

from services.cli.recovery.journal_rows import RecoveryReport
from services.cli.recovery.rebuild import begin_rebuild, rebuild_catalog
from services.steward.tasks import garbage_collection
from services.steward.tasks.compaction import merge_small_chunks
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.garbage_collection import collect_deleted_photos
from services.steward.tasks.model_changes import advance_model_changes
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.api_keys import authenticate_api_key, create_api_key
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.base import Base
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Evaluation, Generation, GenerationState
from shared.catalog.installation import (
    Installation,
    adopt_store,
    check_not_behind,
    get_or_create_installation,
)
from shared.catalog.jobs import Job, JobKind
from shared.catalog.maps import Map, get_or_create_default_map
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import Reconstruction
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured, StorageFull
from shared.integrity.verify import verify_store
from shared.jobs import InProcessWakeups
from shared.journal.outbox import write_journal, write_snapshot
from shared.security.api_keys import Scope, hash_api_key
from shared.storage import FolderStore
from shared.storage.chunks import manifest_key
from shared.storage.keys import JOURNAL, ORIGINALS
from shared.storage.ownership import read_owner
from shared.storage.segments import list_segments
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_job, add_reconstruction
from tests.support.photos import photo_bytes

pytestmark = pytest.mark.databases("postgresql")

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


def rebuild(service: Service) -> RecoveryReport:
    owner = read_owner(service.store)
    begin_rebuild(service.catalog, service.store, UUID(owner) if owner else None)
    return rebuild_catalog(service.catalog, service.store, service.settings, with_unnamed=True)


def rebuilt(service: Service) -> tuple[Service, RecoveryReport]:
    """Services on the rebuilt catalog."""
    taken = rebuild(service)
    return Service(service.catalog, service.store, service.settings, service.make_worker), taken


def photo(service: Service, file_id: str, map_name: str = "default") -> Any:
    return service.json("GET", f"/uploads/{file_id}", params={"map": map_name})


def answers(service: Service, file_id: str, map_name: str = "default") -> Any:
    service.search.sync()
    found = service.json("POST", f"/similarity/{file_id}", params={"map": map_name})
    return found["similar_images"]


def two_maps(service: Service) -> dict[str, str]:
    """Photos of two maps of two extractors, a labelled query, one that was patched and one in the
    trash: the map of each that is left."""
    halls_map = {"name": "halls", "extractor": "test-tiny-vlad", "rows": "float16"}
    service.json("POST", "/maps", 201, json=halls_map)
    first, second, gone = service.indexed(1, 2, 3, **SAID)
    nowhere = {"place": "bridge", "latitude": None, "longitude": None}
    service.json("PATCH", f"/uploads/{second}", json=nowhere)
    (query,) = service.indexed(4, role="query", place="tower")
    halls = [service.upload(photo_bytes(n), "halls")["file_id"] for n in (1, 5, 6)]
    fit = service("POST", "/vocabularies", params={"map": "halls"}, json={"clusters": 4})
    service.done(fit, "halls")
    service.json("DELETE", f"/uploads/{gone}")
    return dict.fromkeys((first, second, query), "default") | dict.fromkeys(halls, "halls")


@pytest.mark.databases("sqlite", "postgresql")
def test_every_photo_is_searchable_again_with_its_metadata(
    service: Service,
    store: FolderStore,
    settings: Settings,
) -> None:
    left = two_maps(service)
    service.json("PATCH", "/maps/halls", json={"matching": "on"})
    matched = [(m["matching"], m["local_features"]) for m in service.json("GET", "/maps")]
    assert [features["photos"] for _, features in matched] == [4, 3]
    rows = [each["rows"] for each in service.json("GET", "/generations", params={"map": "halls"})]
    assert set(rows) == {"float16"}
    service.json("POST", "/maps", 201, json={"name": "gone"})
    service.indexed(9, map_name="gone")
    service.json("DELETE", "/maps/gone")
    write_journal(service.catalog, store)
    with service.catalog.write() as session:
        installation_id = get_or_create_installation(session).id
    adopt_store(service.catalog, store)
    fields = {file_id: photo(service, file_id, name) for file_id, name in left.items()}
    before = {file_id: answers(service, file_id, name) for file_id, name in left.items()}
    assert all(before.values())
    removed = service.json("GET", "/search", params={"removed": True})["images"]

    lose_catalog(service.catalog)
    with service.catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)  # as a first start has left it
    service, taken = rebuilt(service)
    assert (taken.maps, taken.photos, taken.queued_photos) == (2, 7, 0)
    assert taken.descriptors == 7
    assert taken.unnamed_photos == taken.lost_originals == 0
    assert {file_id: photo(service, file_id, name) for file_id, name in left.items()} == fields
    assert {file_id: answers(service, file_id, name) for file_id, name in left.items()} == before
    with service.catalog.read() as session:
        assert session.scalars(select(Installation.id)).one() == installation_id
        in_trash = session.scalars(select(Photo).where(Photo.deleted_at.is_not(None))).one()
        assert in_trash.deleted_at is not None
        assert in_trash.purge_at == in_trash.deleted_at + timedelta(days=30)
    assert service.json("GET", "/search", params={"removed": True})["images"] == removed
    assert verify_store(service.catalog, store, originals=True).faults == []
    check_not_behind(service.catalog, store)
    maps = service.json("GET", "/maps")
    assert [m["name"] for m in maps] == ["default", "halls"]
    assert [(m["matching"], m["local_features"]) for m in maps] == matched
    generations = service.json("GET", "/generations", params={"map": "halls"})
    assert [each["rows"] for each in generations] == rows
    # It goes on: new photos come into the same generations, and the journal too.
    (new,) = service.indexed(7, map_name="halls")
    assert answers(service, new, "halls")
    assert write_journal(service.catalog, store) > 0
    assert collect_orphans(service.catalog, store, -1.0) > 0  # the deleted map's
    assert verify_store(service.catalog, store, originals=True).faults == []


def test_a_finished_reconstruction_comes_back_and_one_that_was_deleted_does_not(
    service: Service, store: FolderStore
) -> None:
    service.indexed(1)
    with service.catalog.write() as session:
        generation = session.scalars(select(Generation)).one()
        kept = add_reconstruction(session, store, generation)
        add_reconstruction(session, store, generation, finished_at=None)
        deleted = add_reconstruction(session, store, generation)
    write_journal(service.catalog, store)
    for key in deleted.list_object_keys(store):
        store.delete(key)
    lose_catalog(service.catalog)
    service, _ = rebuilt(service)
    with service.catalog.read() as session:
        found = session.scalars(select(Reconstruction)).one()
        assert (found.id, found.list_components()) == (kept.id, kept.list_components())


class DyingStore:
    """Dies at a listing of the prefix."""

    def __init__(self, store: FolderStore, prefix: str) -> None:
        self._store, self._prefix = store, prefix

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def list(self, prefix: str) -> Any:
        if prefix == self._prefix:
            raise KeyboardInterrupt
        return self._store.list(prefix)


def test_a_rebuild_that_was_killed_goes_on_and_a_full_catalog_is_refused(
    service: Service, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.indexed(1, 2, 3, **SAID)
    write_journal(service.catalog, store)
    service.upload(photo_bytes(4))
    lose_catalog(service.catalog)

    def die(*_: Any) -> Any:
        raise KeyboardInterrupt

    begin_rebuild(service.catalog, store, None)
    for dying in (DyingStore(store, "chunks/"), store):
        with monkeypatch.context() as patched:
            patched.setattr("services.cli.recovery.rebuild._queue_photos", die)
            with pytest.raises(KeyboardInterrupt):
                rebuild_catalog(
                    service.catalog,
                    dying,
                    service.settings,
                    with_unnamed=True,
                )
        for refused in (check_not_behind, write_snapshot, partial(collect_orphans, age_seconds=-1)):
            with pytest.raises(Misconfigured) as unfinished:
                refused(service.catalog, store)
            assert unfinished.value.code == "rebuild_unfinished"
    assert rebuild(service).photos == 3
    with service.catalog.read() as session:
        for table, rows in ((Photo, 4), (Descriptor, 3), (Chunk, 1), (Job, 1)):
            assert session.scalar(select(func.count()).select_from(table)) == rows, table
    assert verify_store(service.catalog, store, originals=True).faults == []
    with pytest.raises(Conflict, match="photos") as caught:
        rebuild(service)
    assert caught.value.code == "catalog_not_empty"


def test_photos_that_are_not_described_yet_keep_their_jobs_and_failed_ones_are_tried_again(
    service: Service, store: FolderStore
) -> None:
    waiting, failed = (service.upload(photo_bytes(number)) for number in (1, 2))
    write_journal(service.catalog, store)
    lose_catalog(service.catalog)
    service, report = rebuilt(service)
    assert report.queued_photos == 2
    for sent in (waiting, failed):
        assert service.json("GET", f"/jobs/{sent['job_id']}")["state"] == "queued"


def test_history_of_the_last_snapshot_and_reports_and_keys_come_back_but_no_work_in_progress(
    service: Service, store: FolderStore
) -> None:
    (file_id,) = service.indexed(1)
    service.json("POST", f"/similarity/{file_id}")
    service.json("POST", "/tracks", 201, json={})
    with service.catalog.write() as session:
        _, key = create_api_key(session, "theirs", {Scope.READ})
        generation = session.scalars(select(Generation)).one()
        session.add(
            Evaluation(
                map_id=generation.map_id,
                generation_id=generation.id,
                searchable=1,
                labelled_queries=0,
                figures={"recall": 1.0},
            )
        )
        add_job(session, generation.map_id, JobKind.EVALUATE)
    read = ("/searches", "/tracks", "/evaluations")
    before = [service.json("GET", path) for path in read]
    write_snapshot(service.catalog, store, max_age_seconds=0)
    service.json("PATCH", f"/uploads/{file_id}", json={"place": "later"})
    write_journal(service.catalog, store)
    lose_catalog(service.catalog)
    service, _ = rebuilt(service)
    assert [service.json("GET", path) for path in read] == before
    assert photo(service, file_id)["place"] == "later"
    with service.catalog.read() as session:
        assert authenticate_api_key(session, hash_api_key(key)).name == "theirs"
        assert session.scalars(select(Job)).all() == []


def test_a_model_change_of_a_snapshot_that_nothing_follows_is_finished(
    service: Service, store: FolderStore
) -> None:
    left = two_maps(service)
    halls = {"params": {"map": "halls"}, "json": {"clusters": 4, "seed": 1}}
    job_id = service.json("POST", "/vocabularies", 202, **halls)["job_id"]
    service.worker.fits.run_next(threading.Event())
    advance_model_changes(service.catalog, InProcessWakeups())  # queues the photos
    service.worker.drain(threading.Event())
    write_journal(service.catalog, store)
    write_snapshot(service.catalog, store, max_age_seconds=0)
    building = select(Generation.id).where(Generation.state == GenerationState.BUILDING)
    with service.catalog.read() as session:
        generation_id = session.scalars(building).one()
    lose_catalog(service.catalog)
    service, report = rebuilt(service)
    assert report.descriptors == 7 + 3
    assert service.ended(job_id, "halls")["state"] == "succeeded"
    with service.catalog.read() as session:
        assert session.get_one(Generation, generation_id).state == GenerationState.ACTIVE
    in_halls = [file_id for file_id, name in left.items() if name == "halls"]
    assert len(answers(service, in_halls[0], "halls")) == 2
    assert verify_store(service.catalog, store, originals=False).faults == []


def test_photos_that_were_described_after_the_last_snapshot_are_not_described_again(
    service: Service, store: FolderStore
) -> None:
    service.indexed(1)
    sent = service.upload(photo_bytes(2))
    write_journal(service.catalog, store)
    write_snapshot(service.catalog, store, max_age_seconds=0)
    service.drain()
    lose_catalog(service.catalog)
    service, report = rebuilt(service)
    assert (report.descriptors, report.queued_photos) == (2, 0)
    assert service.json("GET", f"/jobs/{sent['job_id']}")["state"] == "succeeded"


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
        merge_small_chunks(service.catalog, store, settings, compact_chunks=2) == 1
    )  # the three lie there still
    file_ids += service.indexed(4)
    write_journal(service.catalog, store)
    lose_catalog(service.catalog)
    service, taken = rebuilt(service)
    assert (taken.chunks, taken.descriptors) == (2, 4)
    with service.catalog.read() as session:
        assert set(session.scalars(select(Descriptor.photo_id))) == set(map(UUID, file_ids))
    assert verify_store(service.catalog, store, originals=True).faults == []


def test_uploads_that_the_journal_lacks_are_restored(
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


def test_a_store_without_a_journal_is_rebuilt_from_exif(
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


def test_a_photo_whose_original_is_missing_is_not_restored(
    service: Service, store: FolderStore, settings: Settings
) -> None:
    first, _ = service.indexed(1, 2)
    write_journal(service.catalog, store)
    with service.catalog.read() as session:
        store.delete(session.get_one(Photo, UUID(first)).object_key)
    lose_catalog(service.catalog)
    service, taken = rebuilt(service)
    assert (taken.photos, taken.lost_originals, taken.descriptors) == (1, 1, 1)


@pytest.mark.databases("sqlite")
def test_photos_whose_map_is_in_a_damaged_segment_come_into_the_default_map(
    service: Service, store: FolderStore
) -> None:
    service.json("POST", "/maps", 201, json={"name": "halls"})
    (file_id,) = service.indexed(1, map_name="halls")
    write_journal(service.catalog, store)
    (damaged,) = (segment.key for segment in list_segments(store))
    with service.catalog.write() as session:
        session.get_one(Photo, UUID(file_id)).place = "later"
    write_journal(service.catalog, store)
    store.put(damaged, b"no gzip")
    lose_catalog(service.catalog)
    service, report = rebuilt(service)
    assert [reason.split()[0] for reason in report.damaged_segments] == [damaged]
    assert (report.photos, report.unnamed_photos) == (0, 1)
    with service.catalog.read() as session:
        assert session.scalars(select(Map.name).join(Photo, Photo.map_id == Map.id)).all() == [
            "default"
        ]


def test_bytes_are_deleted_once_the_journal_has_the_deletion(
    service: Service, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.json("POST", "/maps", 201, json={"name": "other"})
    photos = service.indexed(1)
    service.indexed(2, map_name="other")
    write_journal(service.catalog, store)
    service.json("DELETE", f"/uploads/{photos[0]}", params={"permanently": True})
    service.json("DELETE", "/maps/other")

    def full(*_: Any) -> Any:
        raise StorageFull("disk_full", "The disk is full.")

    def round_() -> int:
        collect_deleted_photos(service.catalog, store, 0)
        purge_deleted_maps(service.catalog, store)
        return len(list(store.list(ORIGINALS)))

    with monkeypatch.context() as patched:
        patched.setattr(garbage_collection, "write_journal", full)
        assert round_() == 2
        patched.setattr(garbage_collection, "MAX_JOURNAL_WAIT_SECONDS", -1.0)
        assert round_() == 0, "only deleting makes room in a full store"
        with service.catalog.read() as session:
            assert session.get(Photo, UUID(photos[0])) is not None, "the journal is written later"
    assert round_() == 0
    text = json.dumps([info.key for info in store.list(JOURNAL)])
    assert len(list_segments(store)) == 2, text
    with service.catalog.read() as session:
        assert session.get(Photo, UUID(photos[0])) is None
        assert session.scalar(select(func.count()).select_from(Generation)) == 1
