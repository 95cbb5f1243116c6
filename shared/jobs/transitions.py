"""Ending a job, or giving it back. Callers hold the job's row and have checked its token.

Ending a batch early, with what of it has not ended.

Trying again what a batch has not brought in.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session, object_session

from shared.catalog.base import Condition, db_now, db_now_plus
from shared.catalog.batch_items import ITEMS_PER_STATEMENT, BatchItem, BatchSource, sync_item_states
from shared.catalog.jobs import (
    CHECKPOINTED_JOBS,
    MODEL_CHANGE_JOBS,
    UNFINISHED_STATES,
    Job,
    JobKind,
    JobState,
    Priority,
    WaitingFor,
)
from shared.catalog.maps import Map
from shared.catalog.photos import Photo, get_live_photos
from shared.catalog.webhooks import EventKind, enqueue_event, subscribed_webhook_ids
from shared.errors import Conflict


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


def cancel_batch(session: Session, job: Job) -> None:
    """Cancel the batch and what of it has not ended; photos that are searchable stay."""
    cancel_job(job)
    cancel_batch_items(session, job)


def cancel_batch_items(session: Session, job: Job) -> None:
    """The batch has ended: so does what of it has not. Of any other job there is nothing."""
    if job.kind != JobKind.BATCH:
        return
    own = select(BatchItem.photo_job_id).where(
        BatchItem.job_id == job.id,
        BatchItem.state == JobState.RUNNING,
        BatchItem.already_there.is_(False),  # those are other uploads' photos
    )
    cancel_jobs(session, Job.id.in_(own))
    sync_item_states(session, job)
    session.execute(
        update(BatchItem)
        .where(BatchItem.job_id == job.id, BatchItem.state.in_(UNFINISHED_STATES))
        .values(state=JobState.CANCELLED)
        .execution_options(synchronize_session=False)
    )


def retry_batch(session: Session, job: Job) -> None:
    """Queue the failed and the cancelled items again, whose bytes are still there.

    Those are in the store with the photo, or under the key that the manifest named; archives and
    refused files are not kept. Conflict (`job_not_retryable`) when nothing can be tried again.
    """
    if job.state in UNFINISHED_STATES:
        raise _batch_not_retryable_error(job, f"is {job.state}: wait for it, or cancel it first")
    items = session.scalars(
        select(BatchItem)
        .where(
            BatchItem.job_id == job.id,
            BatchItem.state.in_((JobState.FAILED, JobState.CANCELLED)),
        )
        .order_by(BatchItem.number)
    ).all()
    from_keys = job.params["source"] in (BatchSource.KEYS, BatchSource.PREFIX)
    again = 0
    for begin in range(0, len(items), ITEMS_PER_STATEMENT):
        some = items[begin : begin + ITEMS_PER_STATEMENT]
        live = get_live_photos(session, [item.photo_id for item in some if item.photo_id])
        for item in some:
            photo = live.get(item.photo_id) if item.photo_id else None
            if photo is not None:
                _retry_item_photo(session, photo, item)
            elif from_keys:
                item.state, item.photo_id, item.photo_job_id = JobState.QUEUED, None, None
            else:
                continue
            item.error = None
            again += 1
    if not again:
        raise _batch_not_retryable_error(
            job,
            "has no item that can be tried again: their bytes were refused and not kept. Upload "
            "them again; what is in the map already is not described twice",
        )
    session.flush()
    requeue_job(job)
    job.stage = "store"
    sync_item_states(session, job)


def _retry_item_photo(session: Session, photo: Photo, item: BatchItem) -> None:
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is not None and job.state in (JobState.FAILED, JobState.CANCELLED):
        requeue_job(job)
    item.state, item.photo_job_id = JobState.RUNNING, photo.job_id


def _batch_not_retryable_error(job: Job, why: str) -> Conflict:
    return Conflict(
        "job_not_retryable", f"The batch {job.id} {why}.", job_id=str(job.id), state=job.state
    )
