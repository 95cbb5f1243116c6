"""Claiming jobs: order, batches, concurrency, on SQLite and on PostgreSQL."""

from __future__ import annotations

import itertools
from functools import partial
from uuid import UUID

import pytest
from sqlalchemy import select

from shared.catalog.database.base import db_now, db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import GenerationState
from shared.catalog.jobs import SINGLE_CLAIM_JOBS, Priority, WaitingFor, get_job, list_jobs
from shared.errors import NotFound
from shared.jobs import Job, JobKind, JobState
from shared.jobs.claim import claim_jobs, fair_batch_size
from tests.contract.jobs.jobs import ids, queue, token_of
from tests.support.catalog_rows import add_generation, add_map, set_columns, take
from tests.support.threads import at_once


def test_jobs_are_claimed_by_priority_then_by_age(catalog: Catalog, map_id: UUID) -> None:
    expected = [
        (JobKind.REINDEX, 4),
        (JobKind.INDEX, 2),
        (JobKind.FIT, 3),
        (JobKind.INDEX, 2),
        (JobKind.DESCRIBE, 1),
        (JobKind.DESCRIBE, 1),
    ]
    made = [(place, queue(catalog, map_id, kind=kind)[0]) for kind, place in expected]
    order = [job_id for _, job_id in sorted(made, key=lambda pair: pair[0])]
    assert [job_id for _ in expected for job_id in ids(take(catalog, limit=1))] == order
    assert take(catalog) == []


def test_a_claim_names_the_worker_and_the_end_of_its_lease(catalog: Catalog, map_id: UUID) -> None:
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


def test_a_job_marked_alone_is_claimed_without_others(catalog: Catalog, map_id: UUID) -> None:
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


def test_jobs_of_single_claim_kinds_are_claimed_one_at_a_time(
    catalog: Catalog, map_id: UUID
) -> None:
    single = [queue(catalog, map_id, 2, kind=kind) for kind in SINGLE_CLAIM_JOBS]
    taken = [ids(take(catalog, limit=10)) for _ in range(2 * len(single))]
    assert {len(jobs) for jobs in taken} == {1}
    assert sorted(taken) == sorted([job_id] for pair in single for job_id in pair)


def test_a_job_with_waiting_for_is_not_claimed(catalog: Catalog, map_id: UUID) -> None:
    queue(catalog, map_id, kind=JobKind.FIT, waiting_for=WaitingFor.DESCRIPTORS)
    ready = queue(catalog, map_id)
    assert ids(take(catalog)) == ready
    assert take(catalog) == []


def test_a_job_is_not_claimed_before_its_run_after(catalog: Catalog, map_id: UUID) -> None:
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


def test_a_claim_with_a_minimum_priority_takes_no_job_below_it(
    catalog: Catalog, map_id: UUID
) -> None:
    bulk = queue(catalog, map_id, 2)
    assert take(catalog, least_priority=Priority.QUERY) == []
    query = queue(catalog, map_id, kind=JobKind.DESCRIBE)
    assert ids(take(catalog, least_priority=Priority.QUERY)) == query
    assert ids(take(catalog)) == bulk


def test_workers_that_claim_at_once_never_get_the_same_job(catalog: Catalog, map_id: UUID) -> None:
    waiting = queue(catalog, map_id, 200) + queue(catalog, map_id, 50, alone=True)

    def work(name: str) -> list[tuple[UUID, UUID]]:
        # A catalog of its own, as another process has it: no lock in memory is shared.
        mine = Catalog(catalog.url.render_as_string(hide_password=False))
        got = []
        while jobs := take(mine, limit=7, worker=name):
            got += [(job.id, token_of(jobs)) for job in jobs]
        mine.close()
        return got

    got = at_once(*(partial(work, f"worker-{number}") for number in range(4)))
    taken = [pair for pairs in got for pair in pairs]
    assert len(taken) == len(waiting)
    assert {job_id for job_id, _ in taken} == set(waiting)
    with catalog.read() as session:
        stored = {(job.id, job.lease_token) for job in session.scalars(select(Job))}
    assert stored == set(taken)


@pytest.mark.databases("postgresql")
def test_a_claim_skips_jobs_that_another_claim_has_locked(catalog: Catalog, map_id: UUID) -> None:
    """SQLite's one writer makes the second worker wait its turn."""
    waiting = queue(catalog, map_id, 6)
    with catalog.write() as first:
        one = claim_jobs(first, worker="one", limit=2, lease_seconds=60)
        # Without SKIP LOCKED this would wait for the first one's commit, and never end.
        two = take(catalog, limit=3, worker="two")
    assert ids(one) == waiting[:2]
    assert ids(two) == waiting[2:5]


def test_jobs_of_a_map_are_listed_newest_first_and_filtered(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
    (elsewhere,) = queue(catalog, other)
    old, new = queue(catalog, map_id, 2)
    (failed,) = queue(catalog, map_id, kind=JobKind.DESCRIBE, state=JobState.FAILED)
    (reindex,) = queue(catalog, map_id, kind=JobKind.REINDEX)
    with catalog.read() as session:
        assert ids(list_jobs(session, map_id, [], [], 10, None)) == [failed, new, old]
        assert ids(list_jobs(session, map_id, [], [], 2, None)) == [failed, new]
        assert ids(list_jobs(session, map_id, [], [], 10, new)) == [old]
        assert ids(list_jobs(session, map_id, [JobState.FAILED], [], 10, None)) == [failed]
        assert ids(list_jobs(session, map_id, [], [JobKind.REINDEX], 10, None)) == [reindex]
        with pytest.raises(NotFound):
            get_job(session, map_id, elsewhere)


@pytest.mark.parametrize("waiting", [40, 80, 400])
def test_a_burst_of_jobs_is_shared_between_the_workers(waiting: int) -> None:
    """The first prefetches a batch, as extractors do, before the other comes."""
    shares = [0, 0]
    for worker in itertools.chain([0, 0], itertools.cycle([1, 0])):
        taken = min(fair_batch_size(waiting, 2, 32), waiting)
        shares[worker] += taken
        waiting -= taken
        if not waiting:
            break
    assert min(shares) > 0.3 * sum(shares)


def test_a_single_worker_or_a_long_queue_has_full_batches() -> None:
    assert fair_batch_size(5, 1, 32) == 32
    assert fair_batch_size(1000, 2, 32) == 32
