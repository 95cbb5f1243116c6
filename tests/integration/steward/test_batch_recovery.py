"""Batches whose steward is killed at any step, or whose store is away or full."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import func, select

from services.steward.batches import worker
from services.steward.batches.worker import resume_batches
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.batch_items import BatchItem
from shared.catalog.photos import Photo
from shared.errors import StorageFull, Unavailable
from shared.ingest import store_photo, validation
from shared.jobs import Job, JobKind, JobState
from shared.storage import FolderStore, ObjectStore
from tests.integration.steward.batches import Batches, Killed, codes, counts, files, restart
from tests.support.catalog_rows import read_job


def assert_each_is_there_once(batches: Batches, job_id: UUID, photos: int) -> None:
    job = batches.finish(job_id)
    assert (job["state"], counts(job)) == ("succeeded", (photos, photos, 0))
    assert len(batches.photos()) == photos
    with batches.catalog.read() as session:
        jobs = session.scalars(select(Job).where(Job.kind == JobKind.INDEX)).all()
    assert len(jobs) == photos
    stored = {photo.object_key for photo in batches.photos()}
    assert stored <= batches.keys("originals/")
    collect_orphans(batches.catalog, batches.store, age_seconds=-60)
    assert batches.keys("originals/") == stored


@pytest.mark.parametrize("step", ["writer", "read_range", "open", "head", "delete"])
@pytest.mark.parametrize("source", ["files", "keys"])
def test_a_steward_killed_at_any_step_leaves_each_photo_once(
    batches: Batches, monkeypatch: pytest.MonkeyPatch, source: str, step: str
) -> None:
    """Each life ends at its nth step of a kind with the object store; the next life is longer."""
    photos = files(*range(6))
    job_id = batches.start(*photos) if source == "files" else batches.start_import(photos)
    real: Any = getattr(FolderStore, step)
    for life in (1, 3, 7):
        left = [life]

        def die(self: FolderStore, *arguments: Any, left: list[int] = left) -> Any:
            left[0] -= 1
            if left[0] == 0:
                raise Killed
            return real(self, *arguments)

        monkeypatch.setattr(FolderStore, step, die)
        try:
            batches.work()
        except Killed:
            monkeypatch.setattr(FolderStore, step, real)
            batches.worker = restart(batches, job_id)
        monkeypatch.setattr(FolderStore, step, real)
    assert_each_is_there_once(batches, job_id, len(photos))


def test_a_steward_killed_in_each_commit_leaves_each_photo_once(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start_import(files(*range(5)))
    real = store_photo.insert_photo

    def put_then_die(*arguments: Any) -> Any:
        real(*arguments)
        raise Killed

    for life in range(2):
        monkeypatch.setattr(worker, "insert_photo", put_then_die)
        with pytest.raises(Killed):
            batches.work()
        monkeypatch.setattr(worker, "insert_photo", real)
        assert batches.photos() == [], life
        batches.worker = restart(batches, job_id)
    assert len(batches.keys("originals/")) == 2, "orphans of the two lives"
    batches.work(batches.new_worker())
    assert_each_is_there_once(batches, job_id, 5)


def test_a_steward_whose_lease_was_taken_over_commits_nothing(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start_import(files(*range(4)))
    real: Any = FolderStore.writer
    slow = batches.worker

    def be_slow(self: FolderStore, key: str) -> Any:
        monkeypatch.setattr(FolderStore, "writer", real)
        other = restart(batches, job_id)
        assert batches.work(other)
        return real(self, key)

    monkeypatch.setattr(FolderStore, "writer", be_slow)
    assert batches.work(slow)
    assert_each_is_there_once(batches, job_id, 4)


def test_an_item_that_crashes_the_steward_fails_and_the_others_succeed(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start_import(files(*range(4)))
    real = validation.validate_photo

    def die_of_one(store: ObjectStore, received: Any, *rest: Any, **fields: Any) -> Any:
        if received.filename == "2.jpg":
            raise Killed
        return real(store, received, *rest, **fields)

    monkeypatch.setattr(worker, "validate_photo", die_of_one)
    for _ in range(3):
        with pytest.raises(Killed):
            batches.work()
        batches.worker = restart(batches, job_id)
    job = batches.finish(job_id)
    assert (job["state"], counts(job)) == ("succeeded", (3, 4, 1))
    assert codes(batches.items(job_id)) == [None, None, "worker_crashed", None]


@pytest.mark.parametrize(
    ("error", "waiting_for"),
    [
        (Unavailable("object_store_unavailable", "gone for lunch"), None),
        (StorageFull("object_store_full", "no room"), "disk_space"),
    ],
)
def test_a_batch_pauses_while_the_object_store_is_unreachable_or_full(
    batches: Batches, monkeypatch: pytest.MonkeyPatch, error: Exception, waiting_for: str | None
) -> None:
    job_id = batches.start_import(files(1, 2))

    def fail(self: FolderStore, key: str) -> Any:
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(FolderStore, "writer", fail)
        assert batches.work()
    job = read_job(batches.catalog, job_id)
    assert (job.state, job.attempts, job.waiting_for) == (JobState.RUNNING, 0, waiting_for)
    assert job.run_after is not None or waiting_for
    resume_batches(batches.catalog, batches.settings)
    assert_each_is_there_once(batches, job_id, 2)


def test_a_batch_waits_while_the_disk_is_full_and_goes_on_by_itself(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start_import(files(1, 2))
    free = SimpleNamespace(free=batches.settings.min_free_bytes - 1)
    monkeypatch.setattr("shared.config.disk_space.shutil.disk_usage", lambda folder: free)
    assert batches.work()
    for _ in range(2):
        resume_batches(batches.catalog, batches.settings)
        assert not batches.work(), "nothing is taken while it waits"
    job = batches.job(job_id)
    assert (job["state"], job["waiting_for"]) == ("running", "disk_space")
    assert (job["stage"], counts(job), batches.photos()) == ("store", (0, 2, 0), [])
    free.free += 1
    resume_batches(batches.catalog, batches.settings)
    assert_each_is_there_once(batches, job_id, 2)


def test_objects_of_a_pending_batch_are_no_orphans(batches: Batches) -> None:
    job_id = batches.start(*files(1, 2))
    collect_orphans(batches.catalog, batches.store, age_seconds=-60)
    assert counts(batches.finish(job_id)) == (2, 2, 0)


def test_deleting_the_job_of_a_batch_deletes_its_items(batches: Batches) -> None:
    job_id = batches.start(*files(1))
    batches.finish(job_id)
    with batches.catalog.write() as session:
        session.delete(session.get_one(Job, job_id))
    with batches.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(BatchItem)) == 0
        assert session.scalar(select(func.count()).select_from(Photo)) == 1
