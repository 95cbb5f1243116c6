"""Leases: extension, expiry, lost leases and crashed jobs, on both databases."""

from __future__ import annotations

import datetime as datetime_module
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import select
from sqlalchemy.exc import OperationalError

from shared.catalog.database.base import db_now, db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState
from shared.jobs.claim import claim_jobs, mark_started
from shared.jobs.leases import extend_lease, lock_leased_jobs, maintain_lease
from shared.jobs.runner import MAX_ATTEMPTS, reclaim_expired_leases
from shared.jobs.transitions import requeue_job
from tests.contract.jobs.jobs import end, free, ids, queue, token_of
from tests.support.catalog_rows import (
    add_generation,
    add_job,
    expire_lease,
    failure_code,
    is_lock_awaited,
    read_job,
    set_columns,
    states,
    take,
)


@pytest.mark.databases("postgresql")
def test_extending_a_lease_locks_its_jobs_in_the_order_of_finishing_them(
    catalog: Catalog, map_id: UUID
) -> None:
    """PostgreSQL alone. In two orders the lease's thread and the worker's meet in a deadlock."""
    low, high = new_id(), new_id()
    with catalog.write() as session:
        add_job(session, map_id, id=high)  # the table's order is not that of the ids
        add_job(session, map_id, id=low)
    jobs = take(catalog)

    def extend() -> bool:
        with catalog.write() as session:
            return extend_lease(session, token_of(jobs), 60)

    with ThreadPoolExecutor(1) as pool:
        with catalog.write() as session:
            first = [job for job in jobs if job.id == low]
            assert ids(lock_leased_jobs(session, token_of(jobs), first)) == [low]
            extending = pool.submit(extend)
            while not is_lock_awaited(catalog):
                assert not extending.done()
                time.sleep(0.01)
            # The one that waits for the first job must not have the second one already.
            second = select(Job.id).where(Job.id == high).with_for_update(nowait=True)
            assert session.scalar(second) == high
        assert extending.result()


def test_a_worker_whose_lease_was_taken_over_finishes_no_job(
    catalog: Catalog, map_id: UUID
) -> None:
    waiting = queue(catalog, map_id, alone=True)
    slow = take(catalog, worker="slow")
    expire_lease(catalog, *waiting)
    assert free(catalog) == 1
    assert end(catalog, slow) == []  # the lease is gone, no one has the job yet
    quick = take(catalog, worker="quick")
    assert ids(quick) == waiting
    assert end(catalog, slow) == []
    assert states(catalog, waiting) == [JobState.RUNNING]
    assert end(catalog, quick) == waiting
    assert read_job(catalog, waiting[0]).worker == "quick"
    assert end(catalog, quick) == []  # once only


def test_a_worker_finishes_jobs_of_an_expired_lease_that_no_one_took_over(
    catalog: Catalog, map_id: UUID
) -> None:
    waiting = queue(catalog, map_id)
    jobs = take(catalog)
    expire_lease(catalog, *waiting)
    assert end(catalog, jobs) == waiting


def test_extending_moves_the_lease_of_its_token_alone_which_is_reclaimed_on_request_only(
    catalog: Catalog, map_id: UUID
) -> None:
    queue(catalog, map_id, 2, alone=True)
    mine, others = take(catalog), take(catalog)
    expire_lease(catalog, *ids(mine), *ids(others))
    with catalog.write() as session:
        assert extend_lease(session, token_of(mine), 60)
    assert free(catalog) == 1
    assert states(catalog, ids(mine) + ids(others)) == [JobState.RUNNING, JobState.QUEUED]
    with catalog.write() as session:
        assert not extend_lease(session, token_of(others), 60)
        assert not extend_lease(session, new_id(), 60)
    assert read_job(catalog, others[0].id).lease_until is None
    assert free(catalog) == 0
    assert free(catalog, all_leases=True) == 1
    assert states(catalog, ids(mine) + ids(others)) == [JobState.QUEUED, JobState.QUEUED]


def test_a_held_lease_is_extended_while_the_block_runs(catalog: Catalog, map_id: UUID) -> None:
    queue(catalog, map_id)
    (job,) = take(catalog, lease_seconds=60)
    first = read_job(catalog, job.id).lease_until
    assert first is not None
    with maintain_lease(catalog, token_of([job]), lease_seconds=0.15):
        # Each extension sets a lease of 0.15 s, and this one did: 60 s are no more.
        until = _wait_for_another_lease(catalog, job.id, first)
        for _ in range(3):
            until = _wait_for_another_lease(catalog, job.id, until)
    stopped = read_job(catalog, job.id).lease_until
    time.sleep(0.15)
    assert read_job(catalog, job.id).lease_until == stopped


def _wait_for_another_lease(
    catalog: Catalog, job_id: UUID, old: datetime_module.datetime
) -> datetime_module.datetime:
    while True:
        now = read_job(catalog, job_id).lease_until
        assert now is not None
        if now != old:
            return now
        time.sleep(0.01)


def test_a_lease_that_was_taken_over_is_not_extended(catalog: Catalog, map_id: UUID) -> None:
    queue(catalog, map_id)
    (job,) = take(catalog)
    expire_lease(catalog, job.id)
    with maintain_lease(catalog, token_of([job]), lease_seconds=60):
        assert free(catalog) == 1
    with maintain_lease(catalog, token_of([job]), lease_seconds=0.03):
        time.sleep(0.1)
    found = read_job(catalog, job.id)
    assert (found.state, found.lease_token) == (JobState.QUEUED, None)


def test_a_lease_survives_an_outage_of_the_catalog(
    catalog: Catalog, map_id: UUID, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue(catalog, map_id)
    (job,) = take(catalog)
    first = read_job(catalog, job.id).lease_until
    assert first is not None
    away = threading.Event()
    monkeypatch.setattr("shared.jobs.leases.extend_lease", _failing_once(away))
    with maintain_lease(catalog, token_of([job]), lease_seconds=0.15):
        assert away.wait(5)
        _wait_for_another_lease(catalog, job.id, first)


def _failing_once(away: threading.Event) -> Any:
    def extend(*arguments: Any) -> bool:
        if not away.is_set():
            away.set()
            raise OperationalError("the catalog is away", None, Exception())
        return extend_lease(*arguments)

    return extend


def test_jobs_of_a_crashed_batch_are_retried_alone_without_counting_an_attempt(
    catalog: Catalog, map_id: UUID
) -> None:
    waiting = queue(catalog, map_id, 3)
    for _ in range(MAX_ATTEMPTS + 1):  # however often
        for job_id in waiting:
            set_columns(catalog, job_id, alone=False)
        assert len(take(catalog)) == 3
        expire_lease(catalog, *waiting)
        assert free(catalog) == 3
    for job_id in waiting:
        job = read_job(catalog, job_id)
        assert (job.state, job.alone, job.attempts) == (JobState.QUEUED, True, 0)
        assert (job.lease_token, job.lease_until) == (None, None)
    assert [len(take(catalog)) for _ in waiting] == [1, 1, 1]


def test_a_crash_of_a_lone_job_counts_an_attempt_and_the_last_one_fails_it(
    catalog: Catalog, map_id: UUID
) -> None:
    (job_id,) = queue(catalog, map_id)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        assert ids(take(catalog, worker="gpu-7")) == [job_id]
        expire_lease(catalog, job_id)
        assert free(catalog) == 1
        assert read_job(catalog, job_id).attempts == attempt
    job = read_job(catalog, job_id)
    assert failure_code(job) == "worker_crashed"
    assert "gpu-7" in str(job.error)
    assert (job.progress_failed, job.lease_token) == (1, None)
    assert job.finished_at is not None
    assert take(catalog) == []


def test_a_crashed_model_change_stays_running_without_a_lease(
    catalog: Catalog, map_id: UUID
) -> None:
    (job_id,) = queue(catalog, map_id, kind=JobKind.FIT, stage="cluster")
    take(catalog)
    expire_lease(catalog, job_id)
    assert free(catalog) == 1
    job = read_job(catalog, job_id)
    assert (job.state, job.stage, job.attempts) == (JobState.RUNNING, "cluster", 1)
    assert job.lease_token is None
    assert ids(take(catalog)) == [job_id]  # and goes on


def test_a_model_change_that_crashed_too_often_abandons_its_generation(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        add_generation(session, map_id)
        building = add_generation(session, map_id, GenerationState.BUILDING).id
    (job_id,) = queue(catalog, map_id, kind=JobKind.FIT, generation_id=building)
    (reindex,) = queue(
        catalog,
        map_id,
        kind=JobKind.REINDEX,
        generation_id=building,
        run_after=db_now_plus(3600),
    )
    for _ in range(MAX_ATTEMPTS):
        assert ids(take(catalog)) == [job_id]
        expire_lease(catalog, job_id)
        free(catalog)
    assert states(catalog, [job_id, reindex]) == [JobState.FAILED, JobState.CANCELLED]
    with catalog.read() as session:
        generation = session.get_one(Generation, building)
        assert generation.state == GenerationState.ABANDONED
        assert generation.ended_at is not None


@pytest.mark.parametrize("years", [-30, 30])
def test_leases_use_the_clock_of_the_database(
    catalog: Catalog, map_id: UUID, monkeypatch: pytest.MonkeyPatch, years: int
) -> None:
    waiting = queue(catalog, map_id, 2)
    _shift_this_workers_clock(monkeypatch, years * 365 * 86_400.0)
    jobs = take(catalog, lease_seconds=60)
    assert ids(jobs) == waiting
    assert free(catalog) == 0  # a clock 30 years ahead steals nothing
    with catalog.write() as session:
        assert extend_lease(session, token_of(jobs), 60)
    assert free(catalog) == 0
    with catalog.read() as session:
        now = session.execute(select(db_now())).scalar_one()
    for job_id in waiting:
        until = read_job(catalog, job_id).lease_until
        assert until is not None
        assert abs((until - now).total_seconds()) < 120
    expire_lease(catalog, *waiting)
    assert free(catalog) == 2  # and one 30 years behind keeps nothing
    with catalog.write() as session:
        requeue_job(session.get_one(Job, waiting[0]), after_seconds=60)
        requeue_job(session.get_one(Job, waiting[1]), after_seconds=-60)
    assert ids(take(catalog)) == [waiting[1]]


def _shift_this_workers_clock(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Whatever our code could ask for the time is wrong by so much."""
    right, right_ns = time.time, time.time_ns

    class WrongDatetime(datetime_module.datetime):
        @classmethod
        def now(cls, tz: Any = None) -> Any:
            return super().now(tz) + datetime_module.timedelta(seconds=seconds)

        @classmethod
        def utcnow(cls) -> Any:
            return cls.now(datetime_module.UTC).replace(tzinfo=None)

    monkeypatch.setattr(time, "time", lambda: right() + seconds)
    monkeypatch.setattr(time, "time_ns", lambda: right_ns() + int(seconds * 1e9))
    ours = [module for name, module in sys.modules.items() if name.startswith("shared.")]
    for module in ours:
        if getattr(module, "datetime", None) is datetime_module.datetime:
            monkeypatch.setattr(module, "datetime", WrongDatetime)


def test_a_crash_counts_an_attempt_of_a_job_only_after_its_start(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        job_id = add_job(session, map_id).id
    for _ in range(5):
        with catalog.write() as session:
            claim_jobs(session, worker="w", limit=1, lease_seconds=60, started=False)
            assert len(reclaim_expired_leases(session, all_leases=True)) == 1
    job = read_job(catalog, job_id)
    assert (job.state, job.attempts, job.alone) == (JobState.QUEUED, 0, False)
    with catalog.write() as session:
        (job,) = claim_jobs(session, worker="w", limit=1, lease_seconds=60, started=False)
        assert job.lease_token is not None
        mark_started(session, job.lease_token, 1)
    with catalog.write() as session:
        reclaim_expired_leases(session, all_leases=True)
    assert read_job(catalog, job_id).attempts == 1
