"""The steward's duties on a real catalog and a real folder of objects."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID

import pytest
from prometheus_client import CollectorRegistry
from sqlalchemy import func, select, update

from services.steward.metrics import StewardMetrics
from services.steward.scheduler import PeriodicTask, Scheduler
from services.steward.tasks import compaction as compact_module
from services.steward.tasks import orphans as orphans_module
from services.steward.tasks.compaction import merge_slot, merge_small_chunks
from services.steward.tasks.garbage_collection import (
    collect_deleted_photos,
    collect_ended_generations,
    collect_garbage,
    collect_model_change_files,
    collect_queries,
    collect_superseded_chunks,
)
from services.steward.tasks.maintenance import resend_hints
from services.steward.tasks.orphans import (
    CollectionHeld,
    collect_orphans,
    empty_expired_trash,
)
from shared.catalog.base import db_now_plus
from shared.catalog.chunks import Chunk, Descriptor, count_searchable, list_live_chunks
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.idempotency import IdempotencyRecord, RequestIdentity, claim_idempotency_key
from shared.catalog.installation import REBUILDING, get_or_create_installation
from shared.catalog.maps import Map
from shared.catalog.photos import Photo, PresignedUpload, get_photo
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import Vocabulary, VocabularyOrigin
from shared.config.settings import Settings
from shared.ids import new_id
from shared.jobs import InProcessWakeups, Job, JobKind, JobState
from shared.storage import FolderStore
from shared.storage.chunks import read_chunk, write_chunk
from shared.storage.keys import (
    TRASH,
    incoming_key,
    job_work_key,
    key_before_trash,
    new_original_key,
    new_vocabulary_key,
    query_key,
    query_vector_key,
    thumbnail_key,
)
from shared.storage.read_retries import ReadRetries
from shared.storage.trash import Hold, HoldReason, TrashSize, read_hold, restore_trash, write_hold
from tests.integration.workplace import same
from tests.support.catalog_rows import (
    add_chunk,
    add_generation,
    add_job,
    add_map,
    add_photo,
    ask,
    delete,
    row_of,
    stored_rows,
    take,
    upload,
)

HOUR_SECONDS = 3600.0
DAY_SECONDS = 86_400.0
MANY = 100  # chunks that an open slot may have before it is worth merging


class House:
    """A map with an active generation whose chunks the test lays out."""

    def __init__(self, catalog: Catalog, store: FolderStore) -> None:
        self.catalog, self.store = catalog, store
        with catalog.write() as session:
            self.map_id = add_map(session).id
            self.generation_id = add_generation(session, self.map_id).id

    def photos(self, count: int) -> list[UUID]:
        with self.catalog.write() as session:
            return [add_photo(session, self.map_id).id for _ in range(count)]

    def chunks(self, *sizes: int, slot_rows: int = 1000) -> list[list[UUID]]:
        """Publish chunks of these many photos; the photos of each."""
        made = [self.photos(size) for size in sizes]
        for photo_ids in made:
            add_chunk(self.catalog, self.store, self.generation_id, photo_ids, slot_rows)
        return made

    def delete(self, *photo_ids: UUID) -> None:
        for photo_id in photo_ids:
            delete(self.catalog, self.map_id, photo_id)

    def live(self) -> list[tuple[int, int]]:
        """(slot, rows) of the live chunks."""
        with self.catalog.read() as session:
            return [(c.slot, c.rows) for c in list_live_chunks(session, self.generation_id)]

    def check_rows(self, expected: list[UUID]) -> None:
        """The generation holds these photos, each with its own descriptor, and no others."""
        rows = stored_rows(self.catalog, self.store, self.generation_id)
        assert set(rows) == set(expected)
        assert all(same(row, row_of(photo_id)) for photo_id, row in rows.items())
        with self.catalog.read() as session:
            assert count_searchable(session, self.generation_id) == len(expected)
            pointed_at = set(session.scalars(select(Descriptor.chunk_id)))
            assert pointed_at <= {c.id for c in list_live_chunks(session, self.generation_id)}

    def version(self) -> int:
        with self.catalog.read() as session:
            return session.get_one(Map, self.map_id).version

    def change(self, table: type[Any], row_id: UUID, **columns: Any) -> None:
        with self.catalog.write() as session:
            session.execute(
                update(table)
                .where(table.id == row_id)
                .values(**columns)
                .execution_options(synchronize_session=False)
            )

    def objects(self, prefix: str = "") -> set[str]:
        return {
            info.key for info in self.store.list(prefix) if prefix or not info.key.startswith(TRASH)
        }

    def age(self, keys: set[str], seconds: float) -> None:
        then = time.time() - seconds
        for key in keys:
            os.utime(self.store.path(key), (then, then))


@pytest.fixture
def house(catalog: Catalog, store: FolderStore) -> House:
    return House(catalog, store)


# --- compaction ------------------------------------------------------------------------------


def test_small_chunks_of_a_slot_become_one(house: House) -> None:
    photo_ids = sum_of(house.chunks(2, 3, 1))
    version = house.version()
    assert merge_small_chunks(house.catalog, house.store, compact_chunks=3) == 1
    assert house.live() == [(0, 6)]
    house.check_rows(photo_ids)
    assert house.version() == version + 1  # search workers look again
    assert (
        merge_small_chunks(house.catalog, house.store, compact_chunks=3) == 0
    )  # nothing is left to do


def sum_of(parts: list[list[UUID]]) -> list[UUID]:
    return [photo_id for part in parts for photo_id in part]


def test_few_chunks_of_an_open_slot_are_left(house: House) -> None:
    house.chunks(2, 3)
    assert merge_small_chunks(house.catalog, house.store, compact_chunks=3) == 0
    assert house.live() == [(0, 2), (0, 3)]


def test_merging_stays_inside_a_slot_and_never_exceeds_its_rows(house: House) -> None:
    photo_ids = sum_of(house.chunks(3, 4, 3, 5, 5, 9, 1, slot_rows=10))
    assert house.live() == [(0, 3), (0, 4), (0, 3), (1, 5), (1, 5), (2, 9), (2, 1)]
    # The full slots alone: the open one (2) is no worse than it may be.
    assert merge_small_chunks(house.catalog, house.store, MANY) == 2
    assert house.live() == [(0, 10), (1, 10), (2, 9), (2, 1)]
    with house.catalog.read() as session:
        sealed = [chunk.sealed for chunk in list_live_chunks(session, house.generation_id)]
    assert sealed == [True, True, False, False]
    assert merge_small_chunks(house.catalog, house.store, compact_chunks=2) == 1
    assert house.live() == [(0, 10), (1, 10), (2, 10)]
    house.check_rows(photo_ids)


def test_rows_of_deleted_photos_are_dropped(house: House) -> None:
    first, second = house.chunks(5, 5)
    house.delete(first[0], first[4])
    assert merge_small_chunks(house.catalog, house.store, MANY) == 0  # a fifth is not worth it
    house.delete(second[2])
    assert merge_small_chunks(house.catalog, house.store, MANY) == 1
    assert house.live() == [(0, 7)]
    house.check_rows([*first[1:4], *second[:2], *second[3:]])


def test_a_slot_of_deleted_photos_is_left_without_a_chunk(house: House) -> None:
    (photo_ids,) = house.chunks(3)
    house.delete(*photo_ids)
    assert merge_small_chunks(house.catalog, house.store, MANY) == 1
    assert house.live() == []
    house.check_rows([])
    assert merge_small_chunks(house.catalog, house.store, MANY) == 0


def test_rows_that_no_photo_ever_had_are_dropped(house: House) -> None:
    (photo_ids,) = house.chunks(4)
    with house.catalog.write() as session:  # two jobs of the batch were taken over
        for photo_id in photo_ids[:2]:
            session.delete(session.get_one(Descriptor, (house.generation_id, photo_id)))
    assert merge_small_chunks(house.catalog, house.store, MANY) == 1
    assert house.live() == [(0, 2)]
    house.check_rows(photo_ids[2:])


def test_merging_twice_at_once_merges_once(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    photo_ids = sum_of(house.chunks(2, 3))
    together = threading.Barrier(2)

    def read_together(*arguments: Any) -> Any:
        if arguments[1] in first_keys:
            together.wait(timeout=30)  # both have looked at the catalog before one commits
        return read_chunk(*arguments)

    with house.catalog.read() as session:
        first_keys = {list_live_chunks(session, house.generation_id)[0].object_key}
    monkeypatch.setattr(compact_module, "read_chunk", read_together)
    with ThreadPoolExecutor(2) as pool:
        merges = [
            pool.submit(merge_slot, house.catalog, house.store, house.generation_id, 0)
            for _ in range(2)
        ]
        assert sorted(merge.result() for merge in merges) == [False, True]
    assert house.live() == [(0, 5)]
    house.check_rows(photo_ids)


@pytest.fixture
def while_merging(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Has something done after the merge has looked at the catalog, before it commits."""

    def meanwhile(do: Callable[[], object]) -> None:
        calls = iter([do])

        def write(*arguments: Any, **options: Any) -> Any:
            written = write_chunk(*arguments, **options)
            for act in calls:
                act()
                break
            return written

        monkeypatch.setattr(compact_module, "write_chunk", write)

    return meanwhile


Meanwhile = Callable[[Callable[[], object]], None]


def test_a_photo_deleted_while_merging_does_not_come_back(
    house: House, while_merging: Meanwhile
) -> None:
    first, second = house.chunks(2, 3)
    while_merging(lambda: house.delete(first[0]))
    assert merge_slot(house.catalog, house.store, house.generation_id, 0)
    with house.catalog.read() as session:
        assert count_searchable(session, house.generation_id) == 4
    rows = stored_rows(house.catalog, house.store, house.generation_id)
    assert all(same(row, row_of(photo_id)) for photo_id, row in rows.items())
    assert merge_slot(house.catalog, house.store, house.generation_id, 0)
    house.check_rows([first[1], *second])


def test_a_photo_forgotten_while_merging_does_not_come_back(
    house: House, while_merging: Meanwhile
) -> None:
    first, second = house.chunks(2, 3)

    def forget() -> None:
        house.delete(first[0])
        house.change(Photo, first[0], deleted_at=db_now_plus(-2 * HOUR_SECONDS))
        collect_deleted_photos(house.catalog, house.store, HOUR_SECONDS)

    while_merging(forget)
    assert merge_slot(house.catalog, house.store, house.generation_id, 0)
    assert house.live() == [(0, 5)]  # its row is dead
    house.check_rows([first[1], *second])


def test_a_chunk_that_arrives_while_merging_is_not_lost(
    house: House, while_merging: Meanwhile
) -> None:
    first, second = house.chunks(2, 3)
    late: list[UUID] = []
    while_merging(lambda: late.extend(sum_of(house.chunks(2))))
    assert not merge_slot(house.catalog, house.store, house.generation_id, 0)
    assert house.live() == [(0, 2), (0, 3), (0, 2)]
    house.check_rows([*first, *second, *late])


def test_a_corrupt_chunk_stays_and_others_are_merged(house: House) -> None:
    photo_ids = sum_of(house.chunks(5, 5, 3, 3, slot_rows=10))
    with house.catalog.read() as session:
        broken = list_live_chunks(session, house.generation_id)[0].object_key
    whole = house.store.get(broken)
    house.store.put(broken, whole[:-1] + bytes([whole[-1] ^ 1]))
    assert merge_small_chunks(house.catalog, house.store, compact_chunks=2) == 1
    assert house.live() == [(0, 5), (0, 5), (1, 6)]
    house.store.put(broken, whole)
    house.check_rows(photo_ids)


def test_a_corrupt_chunk_is_not_read_with_every_round_of_merging(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    house.chunks(1, 1)
    with house.catalog.read() as session:
        broken = list_live_chunks(session, house.generation_id)[0].object_key
    whole = house.store.get(broken)
    house.store.put(broken, whole[:-1])
    retries = ReadRetries()
    assert merge_small_chunks(house.catalog, house.store, 2, retries) == 0
    house.store.put(broken, whole)
    assert merge_small_chunks(house.catalog, house.store, 2, retries) == 0, "its pause is not over"
    monkeypatch.setattr("shared.storage.read_retries.time.monotonic", lambda: float("inf"))
    assert merge_small_chunks(house.catalog, house.store, 2, retries) == 1


def test_generations_that_no_longer_answer_are_not_merged(house: House) -> None:
    house.chunks(1, 1, 1)
    house.change(Generation, house.generation_id, state=GenerationState.RETIRED)
    assert merge_small_chunks(house.catalog, house.store, compact_chunks=2) == 0


# --- superseded chunks and ended generations -------------------------------------------------


def test_superseded_chunks_go_after_the_grace_and_not_before(house: House) -> None:
    photo_ids = sum_of(house.chunks(2, 3))
    old = house.objects("chunks/")
    merge_slot(house.catalog, house.store, house.generation_id, 0)
    collect_superseded_chunks(house.catalog, house.store, HOUR_SECONDS)
    assert old < house.objects("chunks/")
    with house.catalog.write() as session:
        session.execute(
            update(Chunk)
            .where(Chunk.superseded_at.is_not(None))
            .values(superseded_at=db_now_plus(-HOUR_SECONDS - 1))
        )
    collect_superseded_chunks(house.catalog, house.store, HOUR_SECONDS)
    assert not old & house.objects("chunks/")
    with house.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Chunk)) == 1
    house.check_rows(photo_ids)


def test_ended_generations_lose_their_chunks_after_the_grace_and_not_before(house: House) -> None:
    house.chunks(2, 3)
    with house.catalog.write() as session:
        session.get_one(Generation, house.generation_id).state = GenerationState.RETIRED
        session.flush()
        ended = [house.generation_id]
        ended.append(add_generation(session, house.map_id, GenerationState.ABANDONED).id)
        active = add_generation(session, house.map_id).id
    add_chunk(house.catalog, house.store, ended[1], house.photos(1))
    stay = house.photos(2)
    add_chunk(house.catalog, house.store, active, stay)
    for generation_id in ended:
        house.change(Generation, generation_id, ended_at=db_now_plus(-HOUR_SECONDS + 60))
    collect_ended_generations(house.catalog, house.store, HOUR_SECONDS)
    assert len(house.objects("chunks/")) == 2 * 4
    for generation_id in ended:
        house.change(Generation, generation_id, ended_at=db_now_plus(-HOUR_SECONDS - 1))
    collect_ended_generations(house.catalog, house.store, HOUR_SECONDS)
    assert {key.split("/")[1] for key in house.objects("chunks/")} == {str(active)}
    assert set(stored_rows(house.catalog, house.store, active)) == set(stay)
    with house.catalog.read() as session:
        assert set(session.scalars(select(Descriptor.generation_id))) == {active}
        assert session.scalar(select(func.count()).select_from(Generation)) == 3  # as history
    collect_ended_generations(house.catalog, house.store, HOUR_SECONDS)


# --- deleted photos --------------------------------------------------------------------------


def test_a_deleted_photos_bytes_go_at_once_and_its_row_after_the_grace(house: House) -> None:
    data = b"the bytes"
    photo_id, job_id = upload(house.catalog, house.store, house.map_id, data)
    stays, _ = upload(house.catalog, house.store, house.map_id, b"others")
    add_chunk(house.catalog, house.store, house.generation_id, [photo_id, stays])
    for each in (photo_id, stays):
        house.store.put(thumbnail_key(each), b"small")
    house.delete(photo_id)
    collect_deleted_photos(house.catalog, house.store, HOUR_SECONDS)
    assert house.objects("thumbnails/") == {thumbnail_key(stays)}
    with house.catalog.read() as session:
        assert house.objects("originals/") == {get_photo(session, house.map_id, stays).object_key}
        assert session.get_one(Photo, photo_id).object_key == ""
    again, _ = upload(house.catalog, house.store, house.map_id, data)  # at once, too
    house.delete(again)

    house.change(Photo, photo_id, deleted_at=db_now_plus(-HOUR_SECONDS - 1))
    version = house.version()
    collect_deleted_photos(house.catalog, house.store, HOUR_SECONDS)
    with house.catalog.read() as session:
        assert session.get(Photo, photo_id) is None
        assert session.get(Job, job_id) is None
        assert session.get(Photo, again) is not None  # its grace is not over
    assert house.version() == version + 1
    house.check_rows([stays])
    assert len(house.objects("originals/")) == 1
    last, _ = upload(house.catalog, house.store, house.map_id, data)
    with house.catalog.read() as session:
        assert get_photo(session, house.map_id, last).id == last


def test_bytes_are_gone_before_the_row_that_remembers_them(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo_id, _ = upload(house.catalog, house.store, house.map_id, b"the bytes")
    house.delete(photo_id)
    house.change(Photo, photo_id, deleted_at=db_now_plus(-2 * HOUR_SECONDS))

    def away(*_: Any) -> None:
        raise OSError("the disk is not there")

    with monkeypatch.context() as patched:
        patched.setattr(FolderStore, "delete", away)
        with pytest.raises(OSError, match="disk"):
            collect_deleted_photos(house.catalog, house.store, HOUR_SECONDS)
    with house.catalog.read() as session:
        assert session.get_one(Photo, photo_id).object_key != ""
    collect_deleted_photos(house.catalog, house.store, HOUR_SECONDS)
    assert house.objects("originals/") == set()


# --- queries and work ------------------------------------------------------------------------


def test_queries_go_when_their_time_is_over(house: House) -> None:
    old, young = (ask(house.catalog, house.store, house.map_id, b"q") for _ in range(2))
    for job_id in (old, young):
        house.store.put(query_vector_key(job_id), b"v")
    index = add_one_job(house, JobKind.INDEX)
    for job_id in (old, index):
        house.change(Job, job_id, created_at=db_now_plus(-HOUR_SECONDS - 1))
    collect_queries(house.catalog, house.store, HOUR_SECONDS)
    assert house.objects("queries/") == {query_key(young), query_vector_key(young)}
    with house.catalog.read() as session:
        assert set(session.scalars(select(Job.id))) == {young, index}


def add_one_job(house: House, kind: JobKind, **columns: Any) -> UUID:
    with house.catalog.write() as session:
        return add_job(session, house.map_id, kind, **columns).id


def test_what_a_model_change_kept_goes_when_it_needs_it_no_more(house: House) -> None:
    needed = [
        add_one_job(house, JobKind.FIT),
        add_one_job(house, JobKind.FIT, state=JobState.RUNNING, stage="cluster"),
    ]
    over = [
        add_one_job(house, JobKind.FIT, state=JobState.CANCELLED),
        add_one_job(house, JobKind.FIT, state=JobState.FAILED),
        add_one_job(house, JobKind.FIT, state=JobState.RUNNING, generation_id=house.generation_id),
        new_id(),  # no one knows it
    ]
    for job_id in needed + over:
        house.store.put(job_work_key(job_id, "plan.json"), b"[]")
    house.store.put("work/stray.txt", b"?")
    collect_model_change_files(house.catalog, house.store)
    assert house.objects("work/") == {job_work_key(job_id, "plan.json") for job_id in needed}


# --- orphans ---------------------------------------------------------------------------------


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


# --- the loop --------------------------------------------------------------------------------


def test_collecting_twice_at_once_harms_nothing(house: House, settings: Settings) -> None:
    kept = sum_of(house.chunks(2, 2))
    merge_slot(house.catalog, house.store, house.generation_id, 0)
    gone = [upload(house.catalog, house.store, house.map_id, bytes([n]))[0] for n in range(6)]
    house.delete(*gone)
    ask(house.catalog, house.store, house.map_id, b"query")
    now = settings.model_copy(
        update=dict.fromkeys(
            ("superseded_grace_seconds", "retired_grace_seconds", "query_ttl_seconds"), -1.0
        )
    )
    together = threading.Barrier(2)

    def both() -> None:
        together.wait(timeout=30)
        collect_garbage(house.catalog, house.store, now)

    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(both) for _ in range(2)]:
            done.result()
    house.check_rows(kept)
    assert {key.split("/")[0] for key in house.objects()} == {"chunks", "journal"}
    with house.catalog.read() as session:
        assert set(session.scalars(select(Photo.id))) == set(kept)


def test_a_duty_that_raises_does_not_stop_the_others(house: House, settings: Settings) -> None:
    steward = Scheduler(house.catalog, house.store, InProcessWakeups(), settings)
    done: list[str] = []
    stop = threading.Event()

    def fail() -> None:
        done.append("fail")
        raise RuntimeError("the store is away")

    def work() -> None:
        done.append("work")
        if done.count("fail") > 1:
            stop.set()

    steward.tasks = [PeriodicTask("fail", 0.0, fail), PeriodicTask("work", 0.0, work)]
    steward.run(stop)
    assert done == ["fail", "work", "fail", "work"]  # and it is tried again


def test_each_duty_is_done_by_the_loop(
    house: House, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One round does everything once: each duty leaves its trace."""
    hints = InProcessWakeups()
    soon = settings.model_copy(
        update={"compact_chunks": 2, "orphan_age_seconds": 0.0, "auto_fit_photos": 1}
    )
    kept = sum_of(house.chunks(1, 1))
    gone, _ = upload(house.catalog, house.store, house.map_id, b"gone")
    house.delete(gone)
    with house.catalog.write() as session:
        other = add_map(session, "other", "test-tiny-vlad").id
        waiting = add_photo(session, other).id
        add_job(session, other, photo_id=waiting, waiting_for="vocabulary")
        lost = add_job(session, house.map_id).id
    take(house.catalog)
    house.change(Job, lost, lease_until=db_now_plus(-1))
    house.store.put(new_original_key(), b"orphan")
    house.age(house.objects("originals/"), 60)
    with house.catalog.write() as session:
        made = RequestIdentity("someone", "key", "POST /api/v1/maps", "0" * 64)
        claim_idempotency_key(session, made, lease_seconds=1, life_seconds=-1)
        forgotten = PresignedUpload(
            map_id=house.map_id,
            filename="a.jpg",
            size_bytes=1,
            sha256="0" * 64,
            expires_at=db_now_plus(-1),
        )
        session.add(forgotten)
        session.flush()
    house.store.put(incoming_key(forgotten.id), b"never completed")
    steward = Scheduler(house.catalog, house.store, hints, soon)
    stop = threading.Event()
    steward.tasks.append(PeriodicTask("stop", 0.0, stop.set))
    steward.run(stop)
    assert house.live() == [(0, 2)]
    assert house.objects("originals/") == set()
    assert house.objects("incoming/") == set()
    assert hints.wait(0)
    house.check_rows(kept)
    with house.catalog.read() as session:
        assert session.scalars(select(IdempotencyRecord.id)).all() == []
        assert session.scalars(select(PresignedUpload.id)).all() == []
        assert session.get_one(Job, lost).state == JobState.QUEUED
        fit = session.scalars(select(Job).where(Job.kind == JobKind.FIT)).one()
        assert fit.map_id == other


def test_a_lost_hint_is_sent_again_while_there_is_work(house: House) -> None:
    hints = InProcessWakeups()
    resend_hints(house.catalog, hints)
    assert not hints.wait(0)
    add_one_job(house, JobKind.INDEX, waiting_for="vocabulary")
    add_one_job(house, JobKind.INDEX, run_after=db_now_plus(60))
    resend_hints(house.catalog, hints)
    assert not hints.wait(0)  # no worker could do anything
    add_one_job(house, JobKind.INDEX)
    resend_hints(house.catalog, hints)
    assert hints.wait(0)
    take(house.catalog)
    resend_hints(house.catalog, hints)
    assert not hints.wait(0)


def test_jobs_of_an_abandoned_generation_vanish_after_the_grace(
    house: House, store: FolderStore
) -> None:
    (photo_ids,) = house.chunks(3)
    with house.catalog.write() as session:
        given_up = add_generation(
            session, house.map_id, GenerationState.ABANDONED, ended_at=db_now_plus(-HOUR_SECONDS)
        ).id
        for photo_id in photo_ids:
            add_job(
                session,
                house.map_id,
                JobKind.REINDEX,
                photo_id=photo_id,
                generation_id=given_up,
                state=JobState.CANCELLED,
            )
    collect_ended_generations(house.catalog, store, 2 * HOUR_SECONDS)
    assert count_jobs(house.catalog, given_up) == 3
    collect_ended_generations(house.catalog, store, HOUR_SECONDS / 2)
    assert count_jobs(house.catalog, given_up) == 0
    house.check_rows(photo_ids)


def count_jobs(catalog: Catalog, generation_id: UUID) -> int:
    with catalog.read() as session:
        return len(session.scalars(select(Job).where(Job.generation_id == generation_id)).all())
