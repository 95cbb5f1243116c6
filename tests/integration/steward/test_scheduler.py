"""The scheduler runs every periodic task, and a failing one stops no other."""

from __future__ import annotations

import threading
from functools import partial
from uuid import UUID

import pytest
from sqlalchemy import select

from services.steward.periodic_tasks import PeriodicTask
from services.steward.scheduler import Scheduler
from services.steward.tasks import auto_fit
from services.steward.tasks.compaction import COMPACT_CHUNKS
from services.steward.tasks.garbage_collection import collect_ended_generations, collect_garbage
from services.steward.tasks.maintenance import resend_wakeups
from shared.catalog import vocabularies
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import GenerationState
from shared.catalog.idempotency import StoredResponse
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups, Job, JobKind, JobState
from shared.storage import FolderStore
from shared.storage.keys import new_original_key
from tests.integration.steward.chunk_map import HOUR_SECONDS, ChunkMap
from tests.integration.steward.test_compaction import sum_of
from tests.integration.steward.test_garbage_collection import add_one_job
from tests.support.catalog_rows import (
    add_generation,
    add_job,
    add_map,
    add_photo,
    ask,
    take,
    upload,
)
from tests.support.threads import at_once

pytestmark = pytest.mark.databases("postgresql")


@pytest.mark.databases("sqlite", "postgresql")
def test_concurrent_garbage_collections_are_safe(chunk_map: ChunkMap) -> None:
    retained = sum_of(chunk_map.chunks(2, 2))
    chunk_map.merge_all()
    gone = [
        upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, bytes([n]))[0]
        for n in range(6)
    ]
    chunk_map.delete(*gone)
    ask(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"query")
    collect = partial(
        collect_garbage,
        chunk_map.catalog,
        chunk_map.store,
        query_ttl_seconds=-1.0,
        superseded_grace_seconds=-1.0,
        retired_grace_seconds=-1.0,
    )
    at_once(*[collect] * 2)
    chunk_map.check_rows(retained)
    assert {key.split("/")[0] for key in chunk_map.objects()} == {"chunks", "journal"}
    with chunk_map.catalog.read() as session:
        assert set(session.scalars(select(Photo.id))) == set(retained)


def test_a_task_that_raises_does_not_stop_the_others(
    chunk_map: ChunkMap, settings: Settings
) -> None:
    steward = Scheduler(chunk_map.catalog, chunk_map.store, InProcessWakeups(), settings)
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


@pytest.mark.databases("sqlite")
def test_a_task_that_the_time_makes_due_is_run_again_without_a_commit(
    chunk_map: ChunkMap, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    steward = Scheduler(chunk_map.catalog, chunk_map.store, InProcessWakeups(), settings)
    stop, runs, waits = threading.Event(), [True, True, False], []

    def idle(*_: object) -> None:
        waits.append(len(runs))
        stop.set()

    monkeypatch.setattr(chunk_map.catalog, "wait_for_commit", idle)
    steward.tasks = [PeriodicTask("soon due", 0.0, lambda: runs.pop(0))]
    steward.run(stop)
    assert waits == [0], "it waits for a commit once no time makes more work due"


def test_a_long_task_with_a_thread_of_its_own_delays_no_other(
    chunk_map: ChunkMap, settings: Settings
) -> None:
    steward = Scheduler(chunk_map.catalog, chunk_map.store, InProcessWakeups(), settings)
    stop, short_ran = threading.Event(), threading.Event()

    def run_long() -> None:
        assert short_ran.wait(timeout=60), "the short task waited for the long one"
        stop.set()

    steward.tasks = [
        PeriodicTask("long", 0.0, run_long, own_thread=True),
        PeriodicTask("short", 0.0, short_ran.set),
    ]
    steward.run(stop)


@pytest.mark.databases("sqlite", "postgresql")
def test_the_loop_runs_each_task(
    chunk_map: ChunkMap, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One round does everything once: each task leaves its trace."""
    wakeups = InProcessWakeups()
    soon = settings.model_copy(update={"orphan_age_seconds": 30.0})
    monkeypatch.setattr(vocabularies, "MIN_PHOTOS_TO_FIT", 1)
    monkeypatch.setattr(auto_fit, "QUIET_SECONDS", -1.0)
    retained = sum_of(chunk_map.chunks(*[1] * COMPACT_CHUNKS))
    gone, _ = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"gone")
    chunk_map.delete(gone)
    with chunk_map.catalog.write() as session:
        other = add_map(session, "other", "test-tiny-vlad").id
        add_photo(session, other)
        lost = add_job(session, chunk_map.map_id).id
    take(chunk_map.catalog)
    chunk_map.change(Job, lost, lease_until=db_now_plus(-1))
    chunk_map.store.put(new_original_key(), b"orphan")
    chunk_map.age(chunk_map.objects("originals/"), 60)
    with chunk_map.catalog.write() as session:
        session.add(
            StoredResponse(
                scope="someone",
                key="key",
                fingerprint="0" * 64,
                status=200,
                headers={},
                body="{}",
                expires_at=db_now_plus(-1),
            )
        )
    steward = Scheduler(chunk_map.catalog, chunk_map.store, wakeups, soon)
    stop = threading.Event()

    def stop_when_merged_and_collected() -> None:  # by the tasks that have a thread of their own
        if chunk_map.live() == [COMPACT_CHUNKS] and not chunk_map.objects("originals/"):
            stop.set()

    steward.tasks.append(PeriodicTask("stop", 0.0, stop_when_merged_and_collected))
    steward.run(stop)
    assert chunk_map.live() == [COMPACT_CHUNKS]
    assert chunk_map.objects("originals/") == set()
    assert wakeups.wait(0)
    chunk_map.check_rows(retained)
    with chunk_map.catalog.read() as session:
        assert session.scalars(select(StoredResponse.id)).all() == []
        assert session.get_one(Job, lost).state == JobState.QUEUED
        fit = session.scalars(select(Job).where(Job.kind == JobKind.FIT)).one()
        assert fit.map_id == other


def test_a_lost_wakeup_is_sent_again_while_there_are_jobs(chunk_map: ChunkMap) -> None:
    wakeups = InProcessWakeups()
    resend_wakeups(chunk_map.catalog, wakeups)
    assert not wakeups.wait(0)
    add_one_job(chunk_map, JobKind.FIT, waiting_for="descriptors")
    add_one_job(chunk_map, JobKind.INDEX, run_after=db_now_plus(60))
    resend_wakeups(chunk_map.catalog, wakeups)
    assert not wakeups.wait(0)  # no worker could do anything
    add_one_job(chunk_map, JobKind.INDEX)
    resend_wakeups(chunk_map.catalog, wakeups)
    assert wakeups.wait(0)
    take(chunk_map.catalog)
    resend_wakeups(chunk_map.catalog, wakeups)
    assert not wakeups.wait(0)


@pytest.mark.databases("sqlite", "postgresql")
def test_jobs_of_an_abandoned_generation_vanish_after_the_grace(
    chunk_map: ChunkMap, store: FolderStore
) -> None:
    (photo_ids,) = chunk_map.chunks(3)
    with chunk_map.catalog.write() as session:
        given_up = add_generation(
            session,
            chunk_map.map_id,
            GenerationState.ABANDONED,
            ended_at=db_now_plus(-HOUR_SECONDS),
        ).id
        for photo_id in photo_ids:
            add_job(
                session,
                chunk_map.map_id,
                JobKind.REINDEX,
                photo_id=photo_id,
                generation_id=given_up,
                state=JobState.CANCELLED,
            )
    collect_ended_generations(chunk_map.catalog, store, 2 * HOUR_SECONDS)
    assert count_jobs(chunk_map.catalog, given_up) == 3
    collect_ended_generations(chunk_map.catalog, store, HOUR_SECONDS / 2)
    assert count_jobs(chunk_map.catalog, given_up) == 0
    chunk_map.check_rows(photo_ids)


def count_jobs(catalog: Catalog, generation_id: UUID) -> int:
    with catalog.read() as session:
        return len(session.scalars(select(Job).where(Job.generation_id == generation_id)).all())
