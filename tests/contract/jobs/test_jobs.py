"""The queue's rules, on SQLite and on PostgreSQL alike: who gets which job, and who may end it."""

from __future__ import annotations

import datetime as datetime_module
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import select, text
from sqlalchemy.exc import OperationalError

from shared.catalog.base import db_now, db_now_plus
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import MODEL_CHANGE_JOBS, Priority, WaitingFor, get_job, list_jobs
from shared.catalog.schema import migrate
from shared.catalog.session import Catalog
from shared.errors import Conflict, NotFound, Unprocessable
from shared.ids import new_id
from shared.jobs import (
    InProcessWakeups,
    Job,
    JobKind,
    JobState,
    claim_jobs,
    extend_lease,
    maintain_lease,
    mark_started,
    reclaim_expired_leases,
)
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.model_changes import (
    cancel_model_change,
    create_generation,
    get_unfinished_model_change,
    start_model_change,
    wake_vocabulary_waiters,
)
from shared.jobs.transitions import (
    cancel_job,
    fail_job,
    release_job,
    requeue_job,
    retry_job,
    succeed_job,
)
from tests.support.catalog_rows import (
    add_generation,
    add_job,
    add_map,
    add_photo,
    delete,
    expire_lease,
    read_job,
    set_columns,
    states,
    take,
)
from tests.support.servers import PostgresServer

MAX_ATTEMPTS = 3
PROBLEM = Unprocessable("undecodable_photo", "The photo can't be decoded.").as_problem()


@pytest.fixture
def map_id(catalog: Catalog) -> UUID:
    with catalog.write() as session:
        return add_map(session).id


def queue(catalog: Catalog, map_id: UUID, count: int = 1, **columns: Any) -> list[UUID]:
    """Queue jobs; their ids, oldest first."""
    with catalog.write() as session:
        return [add_job(session, map_id, **columns).id for _ in range(count)]


def ids(jobs: list[Job]) -> list[UUID]:
    return [job.id for job in jobs]


def token_of(jobs: list[Job]) -> UUID:
    (token,) = {job.lease_token for job in jobs}
    assert token is not None
    return token


def end(catalog: Catalog, jobs: list[Job]) -> list[UUID]:
    """Finish what of the claimed jobs is still the worker's; the ids of those."""
    with catalog.write() as session:
        mine = lock_leased_jobs(session, token_of(jobs), jobs)
        for job in mine:
            succeed_job(job, {"done": True})
        return ids(mine)


def free(catalog: Catalog, **options: Any) -> int:
    with catalog.write() as session:
        return reclaim_expired_leases(session, MAX_ATTEMPTS, **options)


# --- claiming --------------------------------------------------------------------------------


def test_higher_priority_goes_first_and_then_age(catalog: Catalog, map_id: UUID) -> None:
    wanted = [
        (JobKind.REINDEX, 4),
        (JobKind.INDEX, 2),
        (JobKind.FIT, 3),
        (JobKind.INDEX, 2),
        (JobKind.DESCRIBE, 1),
        (JobKind.COMPARE, 1),
    ]
    made = [(place, queue(catalog, map_id, kind=kind)[0]) for kind, place in wanted]
    order = [job_id for _, job_id in sorted(made, key=lambda pair: pair[0])]
    assert [job_id for _ in wanted for job_id in ids(take(catalog, limit=1))] == order
    assert take(catalog) == []


def test_a_batch_holds_the_oldest_up_to_its_limit(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id, 5)
    assert ids(take(catalog, limit=3)) == waiting[:3]
    assert ids(take(catalog, limit=3)) == waiting[3:]
    assert take(catalog, limit=3) == []


def test_comparisons_are_claimed_one_at_a_time(catalog: Catalog, map_id: UUID) -> None:
    first, second = queue(catalog, map_id, 2, kind=JobKind.COMPARE)
    assert ids(take(catalog, limit=10)) == [first]
    assert ids(take(catalog, limit=10)) == [second]


def test_a_claim_says_who_has_the_jobs_and_until_when(catalog: Catalog, map_id: UUID) -> None:
    queue(catalog, map_id, 2)
    jobs = take(catalog, worker="gpu-1", lease_seconds=30)
    token_of(jobs)
    with catalog.read() as session:
        now = session.execute(select(db_now())).scalar_one()
        for job in session.scalars(select(Job)):
            assert (job.state, job.worker, job.claimed_together) == (JobState.RUNNING, "gpu-1", 2)
            assert job.started_at is not None
            assert job.lease_until is not None
            assert 0 < (job.lease_until - now).total_seconds() <= 30


def test_a_batch_is_of_one_kind_one_map_and_one_generation(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
        old = add_generation(session, map_id, GenerationState.RETIRED).id
        new = add_generation(session, map_id, GenerationState.BUILDING).id
    groups = [
        {"map_id": map_id, "kind": JobKind.INDEX},
        {"map_id": other, "kind": JobKind.INDEX},
        {"map_id": map_id, "kind": JobKind.DESCRIBE},
        {"map_id": map_id, "kind": JobKind.REINDEX, "generation_id": old},
        {"map_id": map_id, "kind": JobKind.REINDEX, "generation_id": new},
    ]
    expected: list[set[UUID]] = [set() for _ in groups]
    for _ in range(3):  # interleaved, and all of the same priority
        for group, members in zip(groups, expected, strict=True):
            members.update(queue(catalog, priority=1, **group))  # type: ignore[arg-type]
    batches = [set(ids(take(catalog, limit=10))) for _ in groups]
    assert sorted(batches, key=min) == sorted(expected, key=min)
    assert take(catalog) == []


def test_a_job_marked_alone_comes_alone(catalog: Catalog, map_id: UUID) -> None:
    first = queue(catalog, map_id, 2)
    lonely = queue(catalog, map_id, alone=True)
    last = queue(catalog, map_id, 2)
    assert ids(take(catalog)) == first + last
    jobs = take(catalog)
    assert ids(jobs) == lonely
    assert jobs[0].claimed_together == 1
    oldest = queue(catalog, map_id, alone=True)
    queue(catalog, map_id, 2)
    assert ids(take(catalog)) == oldest


def test_a_model_change_comes_alone(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
    changes = [queue(catalog, of, kind=k)[0] for of in (map_id, other) for k in MODEL_CHANGE_JOBS]
    changes += queue(catalog, map_id, 2, kind=JobKind.FIT)  # not even with one of its kind
    taken = [take(catalog, limit=10) for _ in changes]
    assert [len(jobs) for jobs in taken] == [1] * len(changes)
    assert sorted(job.id for jobs in taken for job in jobs) == sorted(changes)


def test_a_job_that_waits_for_something_is_held_back(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id, 2, waiting_for=WaitingFor.VOCABULARY)
    ready = queue(catalog, map_id)
    assert ids(take(catalog)) == ready
    assert take(catalog) == []
    with catalog.write() as session:
        wake_vocabulary_waiters(session, map_id)
    assert ids(take(catalog)) == waiting


def test_waiters_of_another_map_and_for_something_else_stay(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
    queue(catalog, other, waiting_for=WaitingFor.VOCABULARY)
    queue(catalog, map_id, kind=JobKind.FIT, waiting_for=WaitingFor.DESCRIPTORS)
    with catalog.write() as session:
        wake_vocabulary_waiters(session, map_id)
    assert take(catalog) == []


def test_a_job_whose_time_has_not_come_is_held_back(catalog: Catalog, map_id: UUID) -> None:
    later = queue(catalog, map_id, run_after=db_now_plus(3600))
    due = queue(catalog, map_id, run_after=db_now_plus(-0.5))
    jobs = take(catalog)
    assert ids(jobs) == due
    assert jobs[0].run_after is None
    assert take(catalog) == []
    set_columns(catalog, later[0], run_after=db_now_plus(-1))
    assert ids(take(catalog)) == later


def test_finished_jobs_are_not_claimed(catalog: Catalog, map_id: UUID) -> None:
    for state in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED):
        queue(catalog, map_id, state=state)
    assert take(catalog) == []


def test_below_the_least_priority_nothing_is_claimed(catalog: Catalog, map_id: UUID) -> None:
    bulk = queue(catalog, map_id, 2)
    assert take(catalog, least_priority=Priority.QUERY) == []
    query = queue(catalog, map_id, kind=JobKind.DESCRIBE)
    assert ids(take(catalog, least_priority=Priority.QUERY)) == query
    assert ids(take(catalog)) == bulk


def test_every_claim_has_a_fresh_token(catalog: Catalog, map_id: UUID) -> None:
    queue(catalog, map_id, 2)
    tokens = set()
    for _ in range(4):
        jobs = take(catalog)
        assert len(jobs) == 2
        tokens.add(token_of(jobs))
        with catalog.write() as session:
            for job in lock_leased_jobs(session, token_of(jobs), jobs):
                release_job(job)
    assert len(tokens) == 4


def test_workers_that_claim_at_once_never_get_the_same_job(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id, 200) + queue(catalog, map_id, 50, alone=True)
    workers = 4
    together = threading.Barrier(workers)

    def work(name: str) -> list[tuple[UUID, UUID]]:
        # A catalog of its own, as another process has it: no lock in memory is shared.
        mine = Catalog(catalog.url.render_as_string(hide_password=False))
        got = []
        together.wait()
        while jobs := take(mine, limit=7, worker=name):
            got += [(job.id, token_of(jobs)) for job in jobs]
        mine.close()
        return got

    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(work, f"worker-{number}") for number in range(workers)]
        taken = [pair for future in futures for pair in future.result()]
    assert len(taken) == len(waiting)
    assert {job_id for job_id, _ in taken} == set(waiting)
    with catalog.read() as session:
        stored = {(job.id, job.lease_token) for job in session.scalars(select(Job))}
    assert stored == set(taken)


def test_a_claim_passes_over_what_another_one_is_just_taking(postgres: PostgresServer) -> None:
    """PostgreSQL alone: SQLite's one writer makes the second worker wait its turn."""
    catalog = Catalog(postgres.new_database())
    migrate(catalog)
    with catalog.write() as session:
        map_id = add_map(session).id
    waiting = queue(catalog, map_id, 6)
    with catalog.write() as first:
        one = claim_jobs(first, worker="one", limit=2, lease_seconds=60)
        # Without SKIP LOCKED this would wait for the first one's commit, and never end.
        two = take(catalog, limit=3, worker="two")
    assert ids(one) == waiting[:2]
    assert ids(two) == waiting[2:5]
    catalog.close()


def test_extending_a_lease_locks_its_jobs_in_the_order_of_finishing_them(
    postgres: PostgresServer,
) -> None:
    """PostgreSQL alone. In two orders the lease's thread and the worker's meet in a deadlock."""
    catalog = Catalog(postgres.new_database())
    migrate(catalog)
    low, high = new_id(), new_id()
    with catalog.write() as session:
        map_id = add_map(session).id
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
            while not _someone_waits_for_a_lock(catalog):
                assert not extending.done()
                time.sleep(0.01)
            # The one that waits for the first job must not have the second one already.
            second = select(Job.id).where(Job.id == high).with_for_update(nowait=True)
            assert session.scalar(second) == high
        assert extending.result()
    catalog.close()


def _someone_waits_for_a_lock(catalog: Catalog) -> bool:
    waiting = "SELECT count(*) FROM pg_locks WHERE NOT granted"
    with catalog.read() as session:
        return bool(session.scalar(text(waiting)))


# --- leases ----------------------------------------------------------------------------------


def test_a_worker_that_was_taken_over_can_not_finish(catalog: Catalog, map_id: UUID) -> None:
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


def test_only_those_of_a_batch_that_were_not_cancelled_can_be_finished(
    catalog: Catalog, map_id: UUID
) -> None:
    waiting = queue(catalog, map_id, 3)
    jobs = take(catalog)
    with catalog.write() as session:
        cancel_job(get_job(session, map_id, waiting[1], lock=True))
    assert end(catalog, jobs) == [waiting[0], waiting[2]]
    assert states(catalog, waiting) == [
        JobState.SUCCEEDED,
        JobState.CANCELLED,
        JobState.SUCCEEDED,
    ]


def test_an_expired_lease_that_no_one_took_over_still_holds(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id)
    jobs = take(catalog)
    expire_lease(catalog, *waiting)
    assert end(catalog, jobs) == waiting


def test_extending_moves_the_lease_of_its_token_alone(catalog: Catalog, map_id: UUID) -> None:
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


def test_holding_a_lost_lease_does_not_bring_it_back(catalog: Catalog, map_id: UUID) -> None:
    queue(catalog, map_id)
    (job,) = take(catalog)
    expire_lease(catalog, job.id)
    with maintain_lease(catalog, token_of([job]), lease_seconds=60):
        assert free(catalog) == 1
    with maintain_lease(catalog, token_of([job]), lease_seconds=0.03):
        time.sleep(0.1)
    found = read_job(catalog, job.id)
    assert (found.state, found.lease_token) == (JobState.QUEUED, None)


def test_a_lease_is_held_on_although_the_catalog_was_away(
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


def test_leases_that_have_not_expired_stay(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id, 2)
    take(catalog)
    assert free(catalog) == 0
    assert states(catalog, waiting) == [JobState.RUNNING, JobState.RUNNING]


def test_everyones_lease_is_freed_on_request(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id, 2)
    take(catalog)
    assert free(catalog, all_leases=True) == 2
    assert states(catalog, waiting) == [JobState.QUEUED, JobState.QUEUED]


def test_what_fell_in_a_batch_comes_back_alone_and_without_an_attempt(
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


def test_what_fell_alone_has_used_an_attempt_and_fails_with_the_last(
    catalog: Catalog, map_id: UUID
) -> None:
    (job_id,) = queue(catalog, map_id)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        assert ids(take(catalog, worker="gpu-7")) == [job_id]
        expire_lease(catalog, job_id)
        assert free(catalog) == 1
        assert read_job(catalog, job_id).attempts == attempt
    job = read_job(catalog, job_id)
    assert job.state == JobState.FAILED
    assert job.error is not None
    assert job.error["code"] == "worker_fell"
    assert "gpu-7" in job.error["detail"]
    assert (job.progress_failed, job.lease_token) == (1, None)
    assert job.finished_at is not None
    assert take(catalog) == []


def test_a_model_change_that_fell_rests_as_running_without_a_lease(
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


def test_a_model_change_that_fell_too_often_abandons_its_generation(
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
def test_leases_know_no_clock_but_the_databases(
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
        release_job(session.get_one(Job, waiting[0]), after_seconds=60)
        release_job(session.get_one(Job, waiting[1]), after_seconds=-60)
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


# --- ending and giving back ------------------------------------------------------------------


def test_a_finished_job_can_not_be_cancelled(catalog: Catalog, map_id: UUID) -> None:
    for state in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED):
        (job_id,) = queue(catalog, map_id, state=state)
        with pytest.raises(Conflict, match=state) as refused, catalog.write() as session:
            cancel_job(session.get_one(Job, job_id))
        assert refused.value.code == "job_finished"
        assert states(catalog, [job_id]) == [state]


def test_a_cancelled_job_is_over_at_once(catalog: Catalog, map_id: UUID) -> None:
    queued = queue(catalog, map_id, waiting_for=WaitingFor.VOCABULARY)
    running = queue(catalog, map_id)
    jobs = take(catalog)
    with catalog.write() as session:
        for job_id in queued + running:
            cancel_job(session.get_one(Job, job_id))
    assert end(catalog, jobs) == []
    for job_id in queued + running:
        job = read_job(catalog, job_id)
        assert (job.state, job.waiting_for) == (JobState.CANCELLED, None)
        assert (job.lease_token, job.lease_until) == (None, None)
        assert job.finished_at is not None
    assert take(catalog) == []


def test_success_and_failure_are_stored_with_their_figures(catalog: Catalog, map_id: UUID) -> None:
    good, bad = queue(catalog, map_id, 2)
    jobs = take(catalog)
    with catalog.write() as session:
        mine = {job.id: job for job in lock_leased_jobs(session, token_of(jobs), jobs)}
        succeed_job(mine[good], {"row": 1})
        fail_job(mine[bad], PROBLEM)
    done, failed = read_job(catalog, good), read_job(catalog, bad)
    assert (done.result, done.error) == ({"row": 1}, None)
    assert (done.progress_done, done.progress_failed) == (1, 0)
    assert (failed.error, failed.result) == (PROBLEM, None)
    assert (failed.progress_done, failed.progress_failed) == (0, 1)


def test_a_released_job_counts_no_attempt_and_comes_again(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id, 2)
    jobs = take(catalog)
    with catalog.write() as session:
        one, two = lock_leased_jobs(session, token_of(jobs), jobs)
        release_job(one)
        release_job(two, after_seconds=3600)
    assert states(catalog, waiting) == [JobState.QUEUED, JobState.QUEUED]
    assert ids(take(catalog)) == waiting[:1]
    assert [read_job(catalog, job_id).attempts for job_id in waiting] == [0, 0]


def test_a_released_model_change_stays_running(catalog: Catalog, map_id: UUID) -> None:
    for kind in MODEL_CHANGE_JOBS:
        (job_id,) = queue(catalog, map_id, kind=kind)
        jobs = take(catalog)
        with catalog.write() as session:
            release_job(lock_leased_jobs(session, token_of(jobs), jobs)[0])
        job = read_job(catalog, job_id)
        assert (job.state, job.lease_token) == (JobState.RUNNING, None)
        jobs = take(catalog)
        assert ids(jobs) == [job_id]
        end(catalog, jobs)


def test_failed_and_cancelled_jobs_start_anew_when_retried(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        photo = add_photo(session, map_id)
        job = add_job(
            session,
            map_id,
            photo_id=photo.id,
            state=JobState.FAILED,
            attempts=MAX_ATTEMPTS,
            alone=True,
            error=PROBLEM,
            progress_failed=1,
            finished_at=db_now(),
        )
        photo_id, job_id = photo.id, job.id
    with catalog.write() as session:
        retry_job(session, get_job(session, map_id, job_id, lock=True))
    job = read_job(catalog, job_id)
    assert (job.state, job.attempts, job.alone, job.error) == (JobState.QUEUED, 0, False, None)
    assert (job.progress_failed, job.finished_at) == (0, None)
    with catalog.write() as session:
        assert session.get_one(Job, job_id).photo_id == photo_id
        cancel_job(session.get_one(Job, job_id))
    with catalog.write() as session:
        retry_job(session, get_job(session, map_id, job_id, lock=True))
    assert ids(take(catalog)) == [job_id]


def test_only_failed_and_cancelled_jobs_can_be_retried(catalog: Catalog, map_id: UUID) -> None:
    for state in (JobState.QUEUED, JobState.RUNNING, JobState.SUCCEEDED):
        (job_id,) = queue(catalog, map_id, state=state)
        with pytest.raises(Conflict, match=state) as refused, catalog.write() as session:
            retry_job(session, session.get_one(Job, job_id))
        assert refused.value.code == "job_not_retryable"


def test_a_model_change_is_started_anew_and_not_retried(catalog: Catalog, map_id: UUID) -> None:
    for kind in (*MODEL_CHANGE_JOBS, JobKind.REINDEX):
        (job_id,) = queue(catalog, map_id, kind=kind, state=JobState.FAILED)
        with pytest.raises(Conflict) as refused, catalog.write() as session:
            retry_job(session, session.get_one(Job, job_id))
        assert refused.value.code == "job_not_retryable"


def test_the_job_of_a_deleted_photo_can_not_be_retried(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        photo_id = add_photo(session, map_id).id
        job_id = add_job(session, map_id, photo_id=photo_id).id
    delete(catalog, map_id, photo_id)
    assert states(catalog, [job_id]) == [JobState.CANCELLED]
    with pytest.raises(Conflict) as refused, catalog.write() as session:
        retry_job(session, session.get_one(Job, job_id))
    assert refused.value.code == "photo_deleted"


def test_a_requeued_job_has_lost_its_past(catalog: Catalog, map_id: UUID) -> None:
    (job_id,) = queue(catalog, map_id, attempts=2, alone=True)
    jobs = take(catalog)
    with catalog.write() as session:
        requeue_job(session.get_one(Job, job_id))
    assert end(catalog, jobs) == []
    job = read_job(catalog, job_id)
    assert (job.state, job.attempts, job.alone) == (JobState.QUEUED, 0, False)
    assert (job.started_at, job.lease_token, job.result) == (None, None, None)


# --- model changes ---------------------------------------------------------------------------


def test_a_second_model_change_is_refused_and_names_the_first(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
        first = start_model_change(session, map_id, JobKind.FIT, {"seed": 0}).id
        start_model_change(session, other, JobKind.FIT, {"seed": 0})  # each map has its own
    for kind in MODEL_CHANGE_JOBS:
        with pytest.raises(Conflict, match=str(first)) as refused, catalog.write() as session:
            start_model_change(session, map_id, kind, {})
        assert refused.value.code == "model_change_running"
        assert refused.value.extra == {"job_id": str(first)}
    with catalog.write() as session:
        cancel_model_change(session, get_job(session, map_id, first, lock=True))
        assert get_unfinished_model_change(session, map_id) is None
        start_model_change(session, map_id, JobKind.IMPORT, {})


def test_of_model_changes_that_start_at_once_one_wins(catalog: Catalog, map_id: UUID) -> None:
    together = threading.Barrier(4)

    def start() -> UUID | str:
        together.wait()
        try:
            with catalog.write() as session:
                return start_model_change(session, map_id, JobKind.FIT, {}).id
        except Conflict as error:
            return str(error.extra["job_id"])

    with ThreadPoolExecutor(4) as pool:
        outcomes = [future.result() for future in [pool.submit(start) for _ in range(4)]]
    (winner,) = [outcome for outcome in outcomes if isinstance(outcome, UUID)]
    assert outcomes.count(str(winner)) == 3


def test_the_first_generation_of_a_map_answers_at_once_and_releases_who_waited(
    catalog: Catalog, map_id: UUID
) -> None:
    waiting = queue(catalog, map_id, 2, waiting_for=WaitingFor.VOCABULARY)
    job_id = _begin(catalog, map_id)
    with catalog.read() as session:
        generation = session.scalars(select(Generation)).one()
    assert generation.state == GenerationState.ACTIVE
    assert generation.activated_at is not None
    job = read_job(catalog, job_id)
    assert (job.state, job.waiting_for) == (JobState.RUNNING, WaitingFor.DESCRIPTORS)
    assert (job.generation_id, job.lease_token) == (generation.id, None)
    assert ids(take(catalog)) == waiting


def test_a_cancelled_model_change_abandons_what_it_was_building(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        active = add_generation(session, map_id).id
    job_id = _begin(catalog, map_id)
    building = read_job(catalog, job_id).generation_id
    first, second = queue(catalog, map_id, 2, kind=JobKind.REINDEX, generation_id=building)
    done = queue(
        catalog, map_id, kind=JobKind.REINDEX, generation_id=building, state=JobState.FAILED
    )
    uploads = queue(catalog, map_id)
    (running,) = take(catalog, limit=1)  # the upload: higher
    jobs = take(catalog, limit=1)
    assert (running.id, ids(jobs)) == (uploads[0], [first])
    with catalog.write() as session:
        cancel_model_change(session, get_job(session, map_id, job_id, lock=True))
    assert states(catalog, [job_id, first, second]) == [JobState.CANCELLED] * 3
    assert states(catalog, [*done, *uploads]) == [JobState.FAILED, JobState.RUNNING]
    assert end(catalog, jobs) == []  # the worker that has one computes in vain
    with catalog.read() as session:
        assert session.get_one(Generation, active).state == GenerationState.ACTIVE
        assert session.get_one(Generation, building).state == GenerationState.ABANDONED
    _begin(catalog, map_id)  # there is room for the next


def test_cancelling_leaves_a_generation_that_already_answers(
    catalog: Catalog, map_id: UUID
) -> None:
    job_id = _begin(catalog, map_id)
    with catalog.write() as session:
        cancel_model_change(session, get_job(session, map_id, job_id, lock=True))
    with catalog.read() as session:
        assert session.scalars(select(Generation.state)).all() == [GenerationState.ACTIVE]


def _begin(catalog: Catalog, map_id: UUID) -> UUID:
    """A model change up to where it waits for descriptors; its job."""
    with catalog.write() as session:
        template = add_generation(session, map_id, GenerationState.RETIRED)
        job_id = start_model_change(session, map_id, JobKind.FIT, {}).id
    jobs = take(catalog, least_priority=Priority.MODEL_CHANGE)
    while jobs[0].id != job_id:
        jobs = take(catalog, least_priority=Priority.MODEL_CHANGE)
    columns = ("extractor", "spec", "spec_fingerprint", "dimension", "model_id")
    with catalog.write() as session:
        (mine,) = lock_leased_jobs(session, token_of(jobs), jobs)
        create_generation(session, mine, **{name: getattr(template, name) for name in columns})
        session.delete(session.get_one(Generation, template.id))
    return job_id


# --- looking at jobs -------------------------------------------------------------------------


def test_jobs_are_listed_newest_first_and_by_what_is_wanted(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
    queue(catalog, other)
    old, new = queue(catalog, map_id, 2)
    (failed,) = queue(catalog, map_id, kind=JobKind.DESCRIBE, state=JobState.FAILED)
    (reindex,) = queue(catalog, map_id, kind=JobKind.REINDEX)
    with catalog.read() as session:
        assert ids(list_jobs(session, map_id, [], [], 10, None)) == [failed, new, old]
        assert ids(list_jobs(session, map_id, [], [], 2, None)) == [failed, new]
        assert ids(list_jobs(session, map_id, [], [], 10, new)) == [old]
        assert ids(list_jobs(session, map_id, [JobState.FAILED], [], 10, None)) == [failed]
        assert ids(list_jobs(session, map_id, [], [JobKind.REINDEX], 10, None)) == [reindex]


def test_a_job_of_another_map_is_not_found(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
    (job_id,) = queue(catalog, other)
    with catalog.read() as session, pytest.raises(NotFound):
        get_job(session, map_id, job_id)


# --- hints -----------------------------------------------------------------------------------


def test_a_hint_sent_before_the_wait_is_not_lost() -> None:
    hints = InProcessWakeups()
    hints.send()
    assert hints.wait(30)


def test_at_most_one_hint_is_outstanding() -> None:
    hints = InProcessWakeups()
    for _ in range(5):
        hints.send()
    assert hints.wait(30)
    assert not hints.wait(0)


def test_a_waiting_worker_wakes_with_the_hint() -> None:
    hints = InProcessWakeups()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(hints.wait, 60)
        hints.send()
        assert waiting.result(timeout=30)


def test_a_wait_without_a_hint_ends() -> None:
    assert not InProcessWakeups().wait(0.01)


def test_a_job_that_had_not_begun_is_not_blamed_for_the_fall(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        job_id = add_job(session, map_id).id
    for _ in range(5):
        with catalog.write() as session:
            claim_jobs(session, worker="w", limit=1, lease_seconds=60, started=False)
            assert reclaim_expired_leases(session, max_attempts=3, all_leases=True) == 1
    job = read_job(catalog, job_id)
    assert (job.state, job.attempts, job.alone) == (JobState.QUEUED, 0, False)


def test_a_job_that_has_begun_may_be_blamed(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        job_id = add_job(session, map_id).id
        (job,) = claim_jobs(session, worker="w", limit=1, lease_seconds=60, started=False)
        assert job.lease_token is not None
        mark_started(session, job.lease_token, 1)
    with catalog.write() as session:
        reclaim_expired_leases(session, max_attempts=3, all_leases=True)
    assert read_job(catalog, job_id).attempts == 1
