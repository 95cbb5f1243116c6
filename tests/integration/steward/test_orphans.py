"""Objects without a row: trash, restore, hold, concurrency."""

from __future__ import annotations

from typing import Any
from uuid import uuid4

import pytest
from prometheus_client import CollectorRegistry
from sqlalchemy import select, update

from services.steward.metrics import StewardMetrics
from services.steward.scheduler import Scheduler
from services.steward.tasks import orphans as orphans_module
from services.steward.tasks.orphans import (
    MAX_ORPHAN_SHARE,
    CollectionHeld,
    collect_orphans,
    empty_expired_trash,
)
from shared.catalog.generations import Generation
from shared.catalog.installation import adopt_store, get_or_create_installation
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import Vocabulary, VocabularyOrigin
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id
from shared.jobs import InProcessWakeups, Job, JobKind, JobState
from shared.journal.outbox import write_journal
from shared.storage.keys import (
    component_key,
    key_before_trash,
    new_checkpoint_key,
    new_original_key,
    new_vocabulary_key,
    preview_key,
    query_key,
    query_vector_key,
    thumbnail_key,
)
from shared.storage.trash import read_hold, restore_trash
from tests.integration.steward.chunk_map import DAY_SECONDS, ChunkMap
from tests.support.catalog_rows import add_chunk, add_job, add_reconstruction, ask, upload


def put_orphans(chunk_map: ChunkMap, *keys: str) -> None:
    """Store bytes under these keys that no row refers to, as of two days ago."""
    for key in keys:
        chunk_map.store.put(key, b"orphan")
    chunk_map.age(set(keys), 2 * DAY_SECONDS)


def collect(chunk_map: ChunkMap, *, confirmed: bool = False) -> int:
    return collect_orphans(chunk_map.catalog, chunk_map.store, DAY_SECONDS, confirmed=confirmed)


def test_old_orphans_of_every_prefix_go_and_what_is_referred_to_stays(chunk_map: ChunkMap) -> None:
    live = _live_objects(chunk_map)
    orphans = {
        new_original_key(),
        thumbnail_key(new_id()),
        preview_key(new_id()),
        f"chunks/{chunk_map.generation_id}/{new_id()}.npy",
        f"chunks/{chunk_map.generation_id}/{new_id()}.json",
        f"chunks/{new_id()}/{new_id()}.npy",
        new_vocabulary_key(),
        query_key(new_id()),
        query_vector_key(new_id()),
        component_key(new_id(), 0),
        new_checkpoint_key(),
    }
    for key in orphans:
        chunk_map.store.put(key, b"orphan")
    assert chunk_map.objects() == live | orphans
    chunk_map.age(live, 2 * DAY_SECONDS)
    assert collect(chunk_map) == 0  # young ones stay
    assert chunk_map.objects() == live | orphans
    chunk_map.age(orphans, DAY_SECONDS - 60)
    assert collect(chunk_map) == 0
    chunk_map.age(orphans, DAY_SECONDS + 60)
    assert collect(chunk_map) == len(orphans)
    assert chunk_map.objects() == live


def _live_objects(chunk_map: ChunkMap) -> set[str]:
    """One object of each kind that a row refers to; their keys."""
    photo_id, _ = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"photo")
    chunk_map.store.put(thumbnail_key(photo_id), b"small")
    chunk_map.store.put(preview_key(photo_id), b"larger")
    add_chunk(chunk_map.catalog, chunk_map.store, chunk_map.generation_id, [photo_id])
    job_id = ask(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"query")
    chunk_map.store.put(query_vector_key(job_id), b"vector")
    stored, waiting = new_vocabulary_key(), new_vocabulary_key()
    for key in (stored, waiting):
        chunk_map.store.put(key, b"centres")
    with chunk_map.catalog.write() as session:
        session.add(
            Vocabulary(
                map_id=chunk_map.map_id,
                origin=VocabularyOrigin.IMPORTED,
                clusters=1,
                dimension=1,
                object_key=stored,
                sha256="0" * 64,
            )
        )
        add_job(session, chunk_map.map_id, JobKind.IMPORT, params={"object_key": waiting})
        model = new_checkpoint_key()
        chunk_map.store.put(model, b"a COLMAP model")
        add_job(session, chunk_map.map_id, JobKind.RECONSTRUCT, params={"object_key": model})
        add_job(session, chunk_map.map_id, JobKind.RECONSTRUCT, params={"object_key": None})
        generation = session.get_one(Generation, chunk_map.generation_id)
        add_reconstruction(session, chunk_map.store, generation)
    return chunk_map.objects()


def test_orphans_lie_in_the_trash_until_their_days_are_over(chunk_map: ChunkMap) -> None:
    live = _live_objects(chunk_map)
    orphans = {new_original_key(), query_key(new_id())}
    put_orphans(chunk_map, *orphans)
    assert collect(chunk_map) == 2
    trashed = chunk_map.objects("trash/")
    assert {key_before_trash(key) for key in trashed} == orphans
    assert empty_expired_trash(chunk_map.catalog, chunk_map.store, 7.0) == 12
    chunk_map.age(trashed, 7.1 * DAY_SECONDS)
    chunk_map.age({first := min(trashed)}, 6.9 * DAY_SECONDS)
    assert empty_expired_trash(chunk_map.catalog, chunk_map.store, 7.0) == 6
    assert chunk_map.objects("trash/") == {first}
    assert chunk_map.objects() == live


def test_what_is_restored_from_the_trash_is_kept_as_long_as_a_new_orphan(
    chunk_map: ChunkMap,
) -> None:
    live, orphan, taken = _live_objects(chunk_map), new_original_key(), new_original_key()
    put_orphans(chunk_map, orphan, taken)
    assert collect(chunk_map) == 2
    chunk_map.store.put(taken, b"another one")
    restored = {
        key_before_trash(info.key): back
        for info, back in restore_trash(chunk_map.store, "originals/")
    }
    assert restored == {orphan: True, taken: False}
    assert chunk_map.store.get(taken) == b"another one"
    assert collect(chunk_map) == 0
    assert chunk_map.objects() == live | {orphan, taken}
    assert len(chunk_map.objects("trash/")) == 1


def test_collection_of_more_than_a_share_is_held_before_anything_is_moved(
    chunk_map: ChunkMap, settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    monkeypatch.setattr(orphans_module, "HOLD_MIN_ORPHANS", 3)
    live = _live_objects(chunk_map)
    orphans = {new_original_key() for _ in range(4)}
    put_orphans(chunk_map, *orphans)
    metrics = StewardMetrics(CollectorRegistry())
    steward = Scheduler(chunk_map.catalog, chunk_map.store, InProcessWakeups(), settings, metrics)
    (task,) = [task for task in steward.tasks if task.name == "collect_orphans"]
    assert MAX_ORPHAN_SHARE * len(live | orphans) < 4

    task.run()
    assert chunk_map.objects() == live | orphans
    assert chunk_map.objects("trash/") == set()
    assert metrics.collection_held._value.get() == 1
    assert "4 of" in caplog.text
    assert caplog.records[-1].levelname == "ERROR"
    hold = read_hold(chunk_map.store)
    assert hold is not None
    assert "4 of" in hold
    with pytest.raises(CollectionHeld):
        collect(chunk_map)

    assert collect(chunk_map, confirmed=True) == 4
    assert chunk_map.objects() == live
    assert len(chunk_map.objects("trash/")) == 4
    assert read_hold(chunk_map.store) is None
    task.run()
    assert metrics.collection_held._value.get() == 0
    assert metrics.trash_bytes._value.get() == 24


def test_hold_ends_by_itself_once_the_catalog_knows_the_objects_again(
    chunk_map: ChunkMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orphans_module, "HOLD_MIN_ORPHANS", 0)
    photo_id, _ = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"photo")
    with chunk_map.catalog.read() as session:
        key = session.get_one(Photo, photo_id).object_key
    chunk_map.age({key}, 2 * DAY_SECONDS)
    chunk_map.change(Photo, photo_id, object_key="originals/other")
    with pytest.raises(CollectionHeld):
        collect(chunk_map)
    chunk_map.change(Photo, photo_id, object_key=key)
    assert collect(chunk_map) == 0
    assert read_hold(chunk_map.store) is None


def test_no_orphan_is_moved_with_a_catalog_that_is_older_than_its_store(
    chunk_map: ChunkMap,
) -> None:
    put_orphans(chunk_map, orphan := new_original_key())
    write_journal(chunk_map.catalog, chunk_map.store)
    with chunk_map.catalog.write() as session:
        get_or_create_installation(session).journal_sequence = 0
    with pytest.raises(Misconfigured) as caught:
        collect(chunk_map, confirmed=True)
    assert caught.value.code == "catalog_behind"
    assert orphan in chunk_map.objects()
    adopt_store(chunk_map.catalog, chunk_map.store)
    assert collect(chunk_map) == 1


def test_an_orphan_goes_once_no_row_refers_to_it_any_more(chunk_map: ChunkMap) -> None:
    live = _live_objects(chunk_map)
    chunk_map.age(live, 2 * DAY_SECONDS)
    with chunk_map.catalog.write() as session:
        session.execute(update(Job).values(state=JobState.FAILED))  # the uploads, too
    assert collect(chunk_map) == 2
    assert len(chunk_map.objects("vocabularies/")) == 1
    with chunk_map.catalog.read() as session:
        photo_id = session.scalars(select(Photo.id)).one()
    chunk_map.delete(photo_id)
    assert collect(chunk_map) == 2
    # Left by a batch that met the deletion.
    assert chunk_map.objects("thumbnails/") == chunk_map.objects("previews/") == set()


def test_files_that_people_put_beside_the_originals_are_not_removed(chunk_map: ChunkMap) -> None:
    # The AnyLoc similarity service names its photos by a random UUID and their ending.
    theirs = {"originals/.DS_Store", "originals/holiday.jpg", f"originals/{uuid4()}.jpg"}
    orphan = new_original_key(".jpg")
    put_orphans(chunk_map, *theirs, orphan)
    assert collect(chunk_map) == 1
    assert chunk_map.objects() == theirs


def test_stray_files_stop_no_collection_and_go_with_the_orphans(chunk_map: ChunkMap) -> None:
    live = _live_objects(chunk_map)
    with chunk_map.catalog.read() as session:
        photo_id = session.scalars(select(Photo.id)).one()
    stray = {
        "thumbnails/.DS_Store",
        "thumbnails/Thumbs.db",
        f"thumbnails/{photo_id.hex}.jpg",  # nearly a live one
        "chunks/notes.txt",
        "vocabularies/read me.md",
        "queries/not-a-uuid.npy",
        "queries/deep/er",
    }
    put_orphans(chunk_map, *stray, query_key(new_id()))
    chunk_map.age(live, 2 * DAY_SECONDS)
    assert collect(chunk_map) == len(stray) + 1
    assert chunk_map.objects() == live


def test_orphans_beyond_the_limit_of_a_run_are_collected_by_the_next(
    chunk_map: ChunkMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orphans_module, "OBJECTS_PER_LOOKUP", 3)
    monkeypatch.setattr(orphans_module, "MAX_ORPHANS_PER_RUN", 5)
    live = _live_objects(chunk_map)
    put_orphans(chunk_map, *(new_original_key() for _ in range(8)))
    chunk_map.age(live, 2 * DAY_SECONDS)
    moved = [collect(chunk_map) for _ in range(3)]
    assert moved == [5, 3, 0]
    assert chunk_map.objects() == live
