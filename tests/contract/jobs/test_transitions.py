"""Transitions: finish, fail, cancel, retry and requeue jobs, on both databases."""

from __future__ import annotations

from uuid import UUID

import pytest

from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import MODEL_CHANGE_JOBS, WaitingFor, get_job
from shared.errors import Conflict
from shared.jobs import Job, JobKind, JobState
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.runner import MAX_ATTEMPTS
from shared.jobs.transitions import cancel_job, fail_job, retry_job, succeed_job
from tests.contract.jobs.jobs import PROBLEM, end, ids, queue, token_of
from tests.support.catalog_rows import add_job, add_photo, delete, read_job, states, take


def test_a_finished_job_can_not_be_cancelled(catalog: Catalog, map_id: UUID) -> None:
    for state in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED):
        (job_id,) = queue(catalog, map_id, state=state)
        with pytest.raises(Conflict, match=state) as refused, catalog.write() as session:
            cancel_job(session.get_one(Job, job_id))
        assert refused.value.code == "job_finished"
        assert states(catalog, [job_id]) == [state]


def test_a_running_job_is_cancelled_at_once_and_the_others_of_its_batch_go_on(
    catalog: Catalog, map_id: UUID
) -> None:
    queued = queue(catalog, map_id, waiting_for=WaitingFor.SEARCH)
    first, running, last = queue(catalog, map_id, 3)
    jobs = take(catalog)
    cancelled = [*queued, running]
    with catalog.write() as session:
        for job_id in cancelled:
            cancel_job(session.get_one(Job, job_id))
    assert end(catalog, jobs) == [first, last]
    assert states(catalog, [first, last]) == [JobState.SUCCEEDED] * 2
    for job_id in cancelled:
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


def test_retrying_resets_failed_and_cancelled_jobs(catalog: Catalog, map_id: UUID) -> None:
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


def test_only_failed_and_cancelled_jobs_can_be_retried_and_no_model_changes(
    catalog: Catalog, map_id: UUID
) -> None:
    for state in (JobState.QUEUED, JobState.RUNNING, JobState.SUCCEEDED):
        (job_id,) = queue(catalog, map_id, state=state)
        with pytest.raises(Conflict, match=state) as refused, catalog.write() as session:
            retry_job(session, session.get_one(Job, job_id))
        assert refused.value.code == "job_not_retryable"
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
