"""Ending a job, or giving it back. Callers hold the job's row and have checked its token."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session, object_session

from shared.catalog.base import Condition, db_now, db_now_plus
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.catalog.webhooks import EventKind, enqueue_event, subscribed_webhook_ids
from shared.errors import Conflict
from shared.jobs.table import (
    CHECKPOINTED_JOBS,
    MODEL_CHANGE_JOBS,
    UNFINISHED_STATES,
    Job,
    JobKind,
    JobState,
    Priority,
    WaitingFor,
)


def _drop_lease(job: Job) -> None:
    job.lease_token = None
    job.lease_until = None


def _clear_waiting(job: Job) -> None:
    job.waiting_for = None
    job.awaited = None


def succeed_job(job: Job, result: dict[str, Any] | None = None) -> None:
    """The job has done what it promised."""
    job.state = JobState.SUCCEEDED
    job.result = result
    job.error = None
    _clear_waiting(job)
    job.progress_done = job.progress_total - job.progress_failed
    job.finished_at = db_now()
    _drop_lease(job)
    _enqueue_job_event(job, EventKind.JOB_SUCCEEDED)


def fail_job(job: Job, problem: dict[str, Any]) -> None:
    """The job ends with a stored reason: an RFC 9457 problem."""
    job.state = JobState.FAILED
    job.error = problem
    _clear_waiting(job)
    if job.progress_total == 1:
        job.progress_failed = 1
    job.finished_at = db_now()
    _drop_lease(job)
    _enqueue_job_event(job, EventKind.JOB_FAILED)


def _enqueue_job_event(job: Job, event: EventKind) -> None:
    """Tell the webhooks of it; not of each photo of a model change, which is told of as a whole."""
    session = object_session(job)
    assert session is not None, "a job ends in a transaction"
    events = [event] if job.kind != JobKind.REINDEX else []
    if job.kind == JobKind.BATCH:
        events.append(EventKind.BATCH_FINISHED)
    for one in events:
        if subscribed_webhook_ids(session, one):
            enqueue_event(session, one, _event_data(session, job))


def _event_data(session: Session, job: Job) -> dict[str, Any]:
    map_ = session.get(Map, job.map_id)
    return {
        "job_id": str(job.id),
        "kind": job.kind,
        "map": map_.name if map_ else None,
        "state": job.state,
        "file_id": str(job.photo_id) if job.photo_id else None,
        "result": job.result,
        "error": job.error,
    }


def release_job(
    job: Job, *, after_seconds: float = 0.0, waiting_for: WaitingFor | None = None
) -> None:
    """Give the job back without counting an attempt: to go on later, or once something is there.

    A sliced job stays `running` between its slices; everything else is `queued` again.
    """
    job.state = JobState.RUNNING if job.kind in CHECKPOINTED_JOBS else JobState.QUEUED
    job.waiting_for = waiting_for
    job.run_after = db_now_plus(after_seconds) if after_seconds else None
    _drop_lease(job)


def wake_waiting_jobs(session: Session, condition: Condition) -> None:
    """What the jobs waited for is there: they may be claimed."""
    session.execute(
        update(Job)
        .where(Job.waiting_for.is_not(None), condition)
        .values(waiting_for=None)
        .execution_options(synchronize_session=False)
    )


def cancel_job(job: Job) -> None:
    """End the job at once; a worker that has it computes in vain, its token is gone."""
    if job.state not in UNFINISHED_STATES:
        raise Conflict(
            "job_finished",
            f"The job {job.id} is {job.state} and can't be cancelled.",
            job_id=str(job.id),
            state=job.state,
        )
    job.state = JobState.CANCELLED
    _clear_waiting(job)
    job.finished_at = db_now()
    _drop_lease(job)


def cancel_jobs(session: Session, condition: Condition) -> None:
    """Cancel every unfinished job that the condition names, as `cancel` does one."""
    unfinished = (
        select(Job.id)
        .where(condition, Job.state.in_(UNFINISHED_STATES))
        .order_by(Job.id)  # as `held` locks them
        .with_for_update()
    )
    session.execute(
        update(Job)
        .where(Job.id.in_(unfinished))
        .values(
            state=JobState.CANCELLED,
            waiting_for=None,
            awaited=None,
            finished_at=db_now(),
            lease_token=None,
            lease_until=None,
        )
        .execution_options(synchronize_session=False)
    )


def retry_job(session: Session, job: Job) -> None:
    """Queue a failed or cancelled job again, with all its attempts."""
    if job.state not in (JobState.FAILED, JobState.CANCELLED):
        raise Conflict(
            "job_not_retryable",
            f"The job {job.id} is {job.state}; only failed and cancelled jobs can be retried.",
            job_id=str(job.id),
            state=job.state,
        )
    photo = session.get_one(Photo, job.photo_id) if job.photo_id is not None else None
    # A failed reindex job becomes its photo's own job at the switch: from then on it may.
    part_of_a_change = job.kind == JobKind.REINDEX and (photo is None or photo.job_id != job.id)
    if job.kind in MODEL_CHANGE_JOBS or part_of_a_change:
        raise Conflict(
            "job_not_retryable",
            "A model change is started anew, not retried: POST /api/v1/vocabularies or "
            "/api/v1/generations.",
            job_id=str(job.id),
        )
    if job.kind == JobKind.ADD_MODEL:
        raise Conflict(
            "job_not_retryable",
            "The checkpoint is not kept once it was looked at: send it again, POST /api/v1/models.",
            job_id=str(job.id),
        )
    if photo is not None:
        if photo.deleted_at is not None:
            raise Conflict("photo_deleted", "The job's photo was deleted.", job_id=str(job.id))
        photo.job_id = job.id
    requeue_job(job)


def requeue_job(job: Job) -> None:
    """Back to the start, as if it were new."""
    if job.kind == JobKind.REINDEX:
        # The generation that it failed in may be gone: the photo goes to the one that answers.
        job.kind, job.priority, job.generation_id = JobKind.INDEX, Priority.UPLOAD, None
    job.state = JobState.QUEUED
    job.attempts = 0
    job.alone = False
    job.error = None
    job.result = None
    _clear_waiting(job)
    job.run_after = None
    job.progress_done = 0
    job.progress_failed = 0
    job.started_at = None
    job.finished_at = None
    _drop_lease(job)
