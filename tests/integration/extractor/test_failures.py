"""The extractor when photos crash, leases expire, photos are deleted or servers are away."""

from __future__ import annotations

import gc
import os
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from sqlalchemy import func, select
from sqlalchemy.exc import OperationalError

from services.extractor import publish
from services.extractor.worker import ExtractorWorker
from services.steward.tasks.maintenance import reclaim_leases
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.photos import Photo, mark_photo_deleted
from shared.descriptors.backbones.synthetic import TinyBackbone
from shared.descriptors.extractor import Extractor
from shared.imaging.preprocessing import Pixels
from shared.jobs import Job, JobState
from shared.jobs.claim import claim_jobs
from shared.jobs.runner import MAX_ATTEMPTS
from shared.jobs.transitions import requeue_job_as_new
from shared.storage import FolderStore
from tests.integration.extractor.conftest import Hook
from tests.integration.extractor.test_describe_photos import _drain
from tests.integration.harness import Harness, expected_row, once, pixels_of, same
from tests.support.catalog_rows import end_pauses, expire_lease, problem_of, states
from tests.support.photos import photo_bytes

pytestmark = pytest.mark.databases("postgresql")

DAY_SECONDS = 86_400.0


def test_a_photo_that_crashes_the_forward_pass_fails_and_harms_no_other(
    averages: Harness, before_describing: Hook
) -> None:
    poison = pixels_of(photo_bytes(2))
    batches: list[int] = []

    def crash(pixels: list[Pixels]) -> None:
        if any(np.array_equal(one, poison) for one in pixels):
            batches.append(len(pixels))
            raise RuntimeError("CUDA error: an illegal memory access was encountered")

    before_describing(crash)
    photo_ids = averages.upload(1, 2, 3)
    averages.drain()
    # Once with the others, then alone as often as a photo may.
    assert batches == [3] + [1] * MAX_ATTEMPTS
    poisonous = averages.job_of(photo_ids[1])
    assert (poisonous.state, poisonous.attempts) == (JobState.FAILED, 3)
    assert problem_of(poisonous)["code"] == "worker_crashed"
    assert "RuntimeError" in problem_of(poisonous)["detail"]
    for photo_id in (photo_ids[0], photo_ids[2]):
        job = averages.job_of(photo_id)
        assert (job.state, job.alone, job.attempts) == (JobState.SUCCEEDED, True, 0)
    assert set(averages.rows()) == {photo_ids[0], photo_ids[2]}


def test_a_descriptor_that_is_not_finite_is_refused_and_harms_no_other(
    averages: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    poison = pixels_of(photo_bytes(2))
    real = TinyBackbone.features

    def overflow(self: TinyBackbone, pixels: torch.Tensor) -> torch.Tensor:
        features = real(self, pixels).clone()
        for photo, found in zip(pixels.numpy(), features, strict=True):
            if np.array_equal(photo, poison):
                found[3, 5] = np.inf  # one number of one patch
        return features

    monkeypatch.setattr(TinyBackbone, "features", overflow)
    photo_ids = averages.upload(1, 2, 3)
    averages.drain()
    assert averages.ended() == (2, 1)
    refused = averages.job_of(photo_ids[1])
    assert (refused.state, refused.attempts) == (JobState.FAILED, 0)
    assert problem_of(refused)["code"] == "features_not_finite"
    rows = averages.rows()
    assert set(rows) == {photo_ids[0], photo_ids[2]}
    for number, photo_id in ((1, photo_ids[0]), (3, photo_ids[2])):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))


def test_a_crash_between_chunk_and_commit_leaves_an_orphan_that_is_collected(
    averages: Harness, make_worker: Callable[[], ExtractorWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        """Nothing in the worker may catch this, as nothing catches SIGKILL."""

    def die(*_: Any) -> None:
        raise Killed

    photo_ids = averages.upload(1, 2)
    with monkeypatch.context() as patched:
        patched.setattr(publish, "lock_map", die)
        with pytest.raises(Killed):
            averages.drain()
    orphans = averages.keys("chunks/")
    assert len(orphans) == 3  # rows, manifest and local features
    assert averages.rows() == {}
    assert reclaim_leases(averages.catalog, averages.wakeups) == 0  # the lease has to expire first
    expire_lease(averages.catalog, *(averages.job_of(p).id for p in photo_ids))
    assert reclaim_leases(averages.catalog, averages.wakeups) == 2
    _drain(make_worker())
    assert set(averages.rows()) == set(photo_ids)
    live = averages.keys("")
    assert collect_orphans(averages.catalog, averages.store, DAY_SECONDS) == 0  # too young
    for key in live:
        _age(averages.store, key, 2 * DAY_SECONDS)
    assert collect_orphans(averages.catalog, averages.store, DAY_SECONDS) == 3
    assert averages.keys("") == live - orphans
    assert set(averages.rows()) == set(photo_ids)


def _age(store: FolderStore, key: str, seconds: float) -> None:
    then = time.time() - seconds
    os.utime(store.path(key), (then, then))


def test_leases_end_when_the_catalog_becomes_unreachable_during_a_drain(
    averages: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo_ids = averages.upload(*range(12))
    claims, away, write = iter(range(10)), threading.Event(), averages.catalog.write

    def write_or_fail(**options: Any) -> Any:
        if away.is_set():
            raise OperationalError("the catalog is away", None, Exception())
        return write(**options)

    def claim_or_fail(*arguments: Any, **options: Any) -> list[Job]:
        if next(claims) == 2:  # two batches are in the next stages
            away.set()
            write_or_fail()
        return claim_jobs(*arguments, **options)

    monkeypatch.setattr(averages.catalog, "write", write_or_fail)
    monkeypatch.setattr("shared.jobs.runner.claim_jobs", claim_or_fail)
    with pytest.raises(OperationalError):
        averages.drain()
    gc.collect()
    leases = [t.name for t in threading.enumerate() if t.name.startswith("lease-")]
    assert leases == []
    monkeypatch.undo()
    unfinished = [job for job in map(averages.job_of, photo_ids) if job.lease_token is not None]
    expire_lease(averages.catalog, *(job.id for job in unfinished))
    reclaim_leases(averages.catalog, averages.wakeups)
    averages.drain()
    assert set(averages.rows()) == set(photo_ids)


def test_nothing_of_a_batch_is_committed_once_its_lease_was_taken_over(
    averages: Harness, make_worker: Callable[[], ExtractorWorker], before_describing: Hook
) -> None:
    photo_ids = averages.upload(1, 2, 3)
    slow, quick = make_worker(), make_worker()
    seen: list[set[str]] = []

    def take_over() -> None:
        jobs = [averages.job_of(photo_id).id for photo_id in photo_ids]
        expire_lease(averages.catalog, *jobs)
        assert reclaim_leases(averages.catalog, averages.wakeups) == 3
        _drain(quick)
        seen.append(averages.keys("chunks/"))

    before_describing(once(take_over))
    _drain(slow)
    assert set(averages.rows()) == set(photo_ids)
    with averages.catalog.read() as session:
        known = set(session.scalars(select(Chunk.object_key)))
        assert session.scalar(select(func.count()).select_from(Descriptor)) == 3
    assert known <= seen[0]  # all that the catalog knows was there before the slow one came
    assert averages.keys("chunks/") - seen[0]  # its chunk is an orphan
    assert {averages.job_of(photo_id).worker for photo_id in photo_ids} == {"worker-1"}


def test_a_job_that_was_taken_over_leaves_a_dead_row_in_the_chunk(
    averages: Harness, before_describing: Hook
) -> None:
    photo_ids = averages.upload(1, 2, 3)
    lost = averages.job_of(photo_ids[1]).id

    def start_anew() -> None:
        with averages.catalog.write() as session:
            requeue_job_as_new(session.get_one(Job, lost))

    before_describing(once(start_anew))
    averages.drain()
    rows = averages.rows()
    for number, photo_id in enumerate(photo_ids, start=1):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))
    with averages.catalog.read() as session:
        found = session.execute(
            select(Chunk.rows, func.count(Descriptor.photo_id))
            .join(Descriptor, Descriptor.chunk_id == Chunk.id)
            .group_by(Chunk.id, Chunk.rows)
            .order_by(Chunk.id)
        )
        assert [tuple(pair) for pair in found] == [(3, 2), (1, 1)]


def test_a_photo_deleted_while_it_is_described_is_not_in_the_generation(
    averages: Harness, before_describing: Hook
) -> None:
    photo_ids = averages.upload(1, 2, 3)
    goes = averages.job_of(photo_ids[1]).id
    left = averages.job_of(photo_ids[2]).id

    def vanish() -> None:
        averages.delete(photo_ids[1])
        with averages.catalog.write() as session:  # without ending its job
            mark_photo_deleted(session, session.get_one(Photo, photo_ids[2]), 1)

    before_describing(once(vanish))
    assert averages.drain()
    assert set(averages.rows()) == {photo_ids[0]}
    assert states(averages.catalog, [goes, left]) == [JobState.CANCELLED, JobState.CANCELLED]


def test_a_photo_deleted_before_it_is_read_is_not_described(averages: Harness) -> None:
    photo_ids = averages.upload(1, 2)
    job_id = averages.job_of(photo_ids[0]).id
    averages.delete(photo_ids[0])
    with averages.catalog.write() as session:  # the worker had claimed it just before
        requeue_job_as_new(session.get_one(Job, job_id))
    averages.drain()
    assert set(averages.rows()) == {photo_ids[1]}
    assert averages.job(job_id).state == JobState.CANCELLED


@pytest.mark.parametrize("failing", ["", ".partial"])
def test_jobs_pause_while_the_object_store_is_unreachable_and_no_attempt_is_counted(
    averages: Harness, failing: str
) -> None:
    folder, kept = averages.store.root / failing, averages.store.root.with_name("kept")
    photo_ids = averages.upload(1, 2)
    query = averages.ask(photo_bytes(3))
    jobs = [*(averages.job_of(photo_id).id for photo_id in photo_ids), query]
    for _ in range(MAX_ATTEMPTS + 1):
        folder.rename(kept)
        folder.symlink_to(folder)  # each access is an OSError, also that of a decoder
        assert averages.drain()
        folder.unlink()
        kept.rename(folder)
        assert averages.ended() == (0, 0)
        for job in map(averages.job, jobs):
            assert (job.state, job.attempts, job.alone) == (JobState.QUEUED, 0, False)
            assert job.run_after is not None
        assert not averages.drain()  # they pause
        end_pauses(averages.catalog)
    averages.drain()
    assert states(averages.catalog, jobs) == [JobState.SUCCEEDED] * 3
    assert set(averages.rows()) == set(photo_ids)


def test_photos_wait_for_a_worker_that_reproduces_the_generation(
    averages: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    averages.upload(1)
    averages.drain()
    real = Extractor.spec
    with monkeypatch.context() as patched:
        patched.setattr(
            Extractor, "spec", lambda self, *made_with: {**real(self, *made_with), "layer": "other"}
        )
        (photo_id,) = averages.upload(2)
        averages.drain()
    job = averages.job_of(photo_id)
    assert (job.state, job.attempts) == (JobState.QUEUED, 0)
    assert problem_of(job)["code"] == "spec_differs"
    end_pauses(averages.catalog)
    averages.drain()
    job = averages.job_of(photo_id)
    assert (job.state, job.error) == (JobState.SUCCEEDED, None)
