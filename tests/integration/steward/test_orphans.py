"""Objects without a row: trash, restore, hold, concurrency."""

from __future__ import annotations

from typing import Any

import pytest
from prometheus_client import CollectorRegistry
from sqlalchemy import select, update

from services.steward.metrics import StewardMetrics
from services.steward.scheduler import Scheduler
from services.steward.tasks import orphans as orphans_module
from services.steward.tasks.orphans import (
    CollectionHeld,
    collect_orphans,
    empty_expired_trash,
)
from shared.catalog.installation import REBUILDING, get_or_create_installation
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import Vocabulary, VocabularyOrigin
from shared.config.settings import Settings
from shared.ids import new_id
from shared.jobs import InProcessWakeups, Job, JobKind, JobState
from shared.storage.keys import (
    key_before_trash,
    new_original_key,
    new_vocabulary_key,
    query_key,
    query_vector_key,
    thumbnail_key,
)
from shared.storage.trash import Hold, HoldReason, TrashSize, read_hold, restore_trash, write_hold
from tests.integration.steward.chunk_map import DAY_SECONDS, House
from tests.support.catalog_rows import (
    add_chunk,
    add_job,
    ask,
    upload,
)


def test_old_orphans_of_every_prefix_go_and_what_is_referred_to_stays(house: House) -> None:
    live = _live_objects(house)
    orphans = {
        new_original_key(),
        thumbnail_key(new_id()),
        f"chunks/{house.generation_id}/{new_id()}.npy",
        f"chunks/{house.generation_id}/{new_id()}.json",
        f"chunks/{new_id()}/{new_id()}.npy",
        new_vocabulary_key(),
        query_key(new_id()),
        query_vector_key(new_id()),
    }
    for key in orphans:
        house.store.put(key, b"orphan")
    assert house.objects() == live | orphans
    house.age(live, 2 * DAY_SECONDS)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 0  # young ones stay
    assert house.objects() == live | orphans
    house.age(orphans, DAY_SECONDS - 60)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 0
    house.age(orphans, DAY_SECONDS + 60)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == len(orphans)
    assert house.objects() == live


def _live_objects(house: House) -> set[str]:
    """One object of each kind that a row refers to; their keys."""
    photo_id, _ = upload(house.catalog, house.store, house.map_id, b"photo")
    house.store.put(thumbnail_key(photo_id), b"small")
    add_chunk(house.catalog, house.store, house.generation_id, [photo_id])
    job_id = ask(house.catalog, house.store, house.map_id, b"query")
    house.store.put(query_vector_key(job_id), b"vector")
    stored, waiting = new_vocabulary_key(), new_vocabulary_key()
    for key in (stored, waiting):
        house.store.put(key, b"centres")
    with house.catalog.write() as session:
        session.add(
            Vocabulary(
                map_id=house.map_id,
                origin=VocabularyOrigin.IMPORTED,
                clusters=1,
                dimension=1,
                object_key=stored,
                sha256="0" * 64,
            )
        )
        add_job(session, house.map_id, JobKind.IMPORT, params={"object_key": waiting})
    return house.objects()


def test_orphans_lie_in_the_trash_until_their_days_are_over(house: House) -> None:
    live = _live_objects(house)
    orphans = {new_original_key(), query_key(new_id())}
    for key in orphans:
        house.store.put(key, b"orphan")
    house.age(orphans, 2 * DAY_SECONDS)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 2
    trashed = house.objects("trash/")
    assert {key_before_trash(key) for key in trashed} == orphans
    assert empty_expired_trash(house.catalog, house.store, 7.0) == (0, TrashSize(2, 12))
    house.age(trashed, 7.1 * DAY_SECONDS)
    house.age({first := min(trashed)}, 6.9 * DAY_SECONDS)
    assert empty_expired_trash(house.catalog, house.store, 7.0) == (1, TrashSize(1, 6))
    assert house.objects("trash/") == {first}
    assert house.objects() == live


def test_what_is_restored_from_the_trash_is_kept_as_long_as_a_new_orphan(house: House) -> None:
    live, orphan, taken = _live_objects(house), new_original_key(), new_original_key()
    for key in (orphan, taken):
        house.store.put(key, b"orphan")
    house.age({orphan, taken}, 2 * DAY_SECONDS)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 2
    house.store.put(taken, b"another one")
    restored = {
        key_before_trash(info.key): back for info, back in restore_trash(house.store, "originals/")
    }
    assert restored == {orphan: True, taken: False}
    assert house.store.get(taken) == b"another one"
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 0
    assert house.objects() == live | {orphan, taken}
    assert len(house.objects("trash/")) == 1


def test_collection_of_more_than_a_share_is_held_before_anything_is_moved(
    house: House, settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    monkeypatch.setattr(orphans_module, "HOLD_MIN_ORPHANS", 3)
    monkeypatch.setattr(orphans_module, "MAX_REMEMBERED_ORPHANS", 2)
    live = _live_objects(house)
    orphans = {new_original_key() for _ in range(4)}
    for key in orphans:
        house.store.put(key, b"orphan")
    house.age(orphans, 2 * DAY_SECONDS)
    metrics = StewardMetrics(CollectorRegistry())
    steward = Scheduler(house.catalog, house.store, InProcessWakeups(), settings, metrics)
    (duty,) = [duty for duty in steward.tasks if duty.name == "collect orphans"]
    share = settings.collect_max_share
    assert share * len(live | orphans) < 4

    duty.run()
    assert house.objects() == live | orphans
    assert house.objects("trash/") == set()
    assert metrics.collection_held._value.get() == 1
    assert "4 of" in caplog.text
    assert caplog.records[-1].levelname == "ERROR"
    hold = read_hold(house.store)
    assert hold is not None
    assert (hold.reason, hold.orphans, hold.orphan_bytes) == (HoldReason.SHARE, 4, 24)
    with pytest.raises(CollectionHeld):
        collect_orphans(house.catalog, house.store, DAY_SECONDS, max_share=share)

    assert collect_orphans(house.catalog, house.store, DAY_SECONDS, confirmed=True) == 4
    assert house.objects() == live
    assert len(house.objects("trash/")) == 4
    assert read_hold(house.store) is None
    duty.run()
    assert metrics.collection_held._value.get() == 0
    assert metrics.trash_bytes._value.get() == 24


def test_hold_ends_by_itself_once_the_catalog_knows_the_objects_again(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orphans_module, "HOLD_MIN_ORPHANS", 0)
    photo_id, _ = upload(house.catalog, house.store, house.map_id, b"photo")
    with house.catalog.read() as session:
        key = session.get_one(Photo, photo_id).object_key
    house.age({key}, 2 * DAY_SECONDS)
    house.change(Photo, photo_id, object_key="originals/other")
    with pytest.raises(CollectionHeld):
        collect_orphans(house.catalog, house.store, DAY_SECONDS, max_share=0.1)
    house.change(Photo, photo_id, object_key=key)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS, max_share=0.1) == 0
    assert read_hold(house.store) is None


def test_single_orphan_is_held_where_the_catalog_is_behind_or_adopted_the_store(
    house: House,
) -> None:
    house.store.put(orphan := new_original_key(), b"orphan")
    house.age({orphan}, 2 * DAY_SECONDS)
    with house.catalog.write() as session:
        get_or_create_installation(session).journal_sequence = REBUILDING
    with pytest.raises(CollectionHeld) as caught:
        collect_orphans(house.catalog, house.store, DAY_SECONDS)
    assert caught.value.hold.reason == HoldReason.CATALOG_BEHIND
    with house.catalog.write() as session:
        get_or_create_installation(session).journal_sequence = 0
    write_hold(house.store, Hold(HoldReason.ADOPTED, 1, 6, 1))
    assert collect_orphans(house.catalog, house.store, 3 * DAY_SECONDS) == 0  # it is too young
    with pytest.raises(CollectionHeld) as caught:
        collect_orphans(house.catalog, house.store, DAY_SECONDS)
    assert caught.value.hold.reason == HoldReason.ADOPTED
    assert house.objects() == {orphan}
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS, confirmed=True) == 1


def test_an_orphan_goes_once_no_row_refers_to_it_any_more(house: House) -> None:
    live = _live_objects(house)
    house.age(live, 2 * DAY_SECONDS)
    with house.catalog.write() as session:
        session.execute(update(Job).values(state=JobState.FAILED))  # the import, too
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 1
    assert len(house.objects("vocabularies/")) == 1
    with house.catalog.read() as session:
        photo_id = session.scalars(select(Photo.id)).one()
    house.delete(photo_id)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 1
    assert house.objects("thumbnails/") == set()  # left by a batch that met the deletion


def test_files_that_people_put_beside_the_originals_are_not_removed(house: House) -> None:
    theirs = {"originals/.DS_Store", "originals/holiday.jpg", f"originals/{new_id()}.jpg"}
    for key in theirs:
        house.store.put(key, b"not ours")
    house.age(theirs, 2 * DAY_SECONDS)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 0
    assert house.objects() == theirs


def test_stray_files_stop_no_collection_and_go_with_the_orphans(house: House) -> None:
    live = _live_objects(house)
    with house.catalog.read() as session:
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
    orphan = query_key(new_id())
    for key in (*stray, orphan):
        house.store.put(key, b"?")
    house.age(house.objects(), 2 * DAY_SECONDS)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == len(stray) + 1
    assert house.objects() == live


def test_more_orphans_than_one_look_takes_all_go(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orphans_module, "OBJECTS_PER_LOOKUP", 3)
    live = _live_objects(house)
    for _ in range(8):
        house.store.put(new_original_key(), b"orphan")
    house.age(house.objects(), 2 * DAY_SECONDS)
    assert collect_orphans(house.catalog, house.store, DAY_SECONDS) == 8
    assert house.objects() == live
