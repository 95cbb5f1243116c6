"""State transitions of jobs and batches: succeed, fail, requeue, cancel.

Callers hold the lock of the job's row; a worker has also checked its lease token.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import and_, or_, select, update
from sqlalchemy.orm import Session, object_session

from shared.catalog.batch_items import ITEMS_PER_STATEMENT, BatchItem, BatchSource, sync_item_states
from shared.catalog.database.base import Condition, affected_rows, db_now, db_now_plus
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


def _end(job: Job, state: JobState) -> None:
    job.state = state
    _clear_waiting(job)
    _drop_lease(job)
    session = _session_of(job)
    # A value read once: with `db_now()` in their place, each job of a batch is a statement.
    if "now" not in session.info:
        with session.no_autoflush:
            session.info["now"] = session.scalar(select(db_now()))
    job.finished_at = session.info["now"]


def _session_of(job: Job) -> Session:
    session = object_session(job)
    assert session is not None, "a job ends in a transaction"
    return session


def _clear_waiting(job: Job) -> None:
    job.waiting_for = None
    job.awaited = None


def succeed_job(job: Job, result: dict[str, Any] | None = None) -> None:
    """Mark the job as succeeded with its result.

    A job that has a result already has succeeded before, and webhooks got its event
    (`requeue_job_as_new`).
    """
    has_succeeded_before = job.result is not None
    job.result = result
    job.error = None
    job.progress_done = job.progress_total - job.progress_failed
    _end(job, JobState.SUCCEEDED)
    if not has_succeeded_before:
        _enqueue_job_event(job, EventKind.JOB_SUCCEEDED)


def fail_job(job: Job, problem: dict[str, Any]) -> None:
    """Mark the job as failed and store the reason, an RFC 9457 problem."""
    job.error = problem
    if job.progress_total == 1:
        job.progress_failed = 1
    _end(job, JobState.FAILED)
    _enqueue_job_event(job, EventKind.JOB_FAILED)


def _enqueue_job_event(job: Job, event: EventKind) -> None:
    """Queue the job's event for webhooks; a model change sends one event, not one per photo."""
    session = _session_of(job)
    events = [event] if job.kind != JobKind.REINDEX else []
    if job.kind == JobKind.BATCH:
        events.append(EventKind.BATCH_FINISHED)
    for kind in events:
        if subscribed_webhook_ids(session, kind):
            enqueue_event(session, kind, _event_data(session, job))


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


def requeue_job(
    job: Job,
    *,
    after_seconds: float = 0.0,
    waiting_for: WaitingFor | None = None,
    problem: dict[str, Any] | None = None,
) -> None:
    """Return a claimed job to the queue without counting an attempt.

    A checkpointed job stays `running` between its slices; any other job is `queued` again.

    Args:
        waiting_for: What it waits for; it can't be claimed until that is null again.
        problem: Why it has to be retried, an RFC 9457 problem.
    """
    job.state = JobState.RUNNING if job.kind in CHECKPOINTED_JOBS else JobState.QUEUED
    job.waiting_for = waiting_for
    job.run_after = db_now_plus(after_seconds) if after_seconds else None
    job.error = problem
    _drop_lease(job)


def cancel_job(job: Job) -> None:
    """Cancel the job at once; a worker that runs it can't commit, because its token is removed.

    Raises:
        Conflict: `job_finished`.
    """
    if job.state not in UNFINISHED_STATES:
        raise Conflict(
            "job_finished",
            f"The job {job.id} is {job.state} and can't be cancelled.",
            job_id=str(job.id),
            state=job.state,
        )
    _end(job, JobState.CANCELLED)


CANCELLED_PER_TRANSACTION = 1000  # a map, a generation or a batch has as many jobs as photos


def cancel_jobs(session: Session, condition: Condition) -> int:
    """Cancel up to CANCELLED_PER_TRANSACTION unfinished jobs that match; return their number.

    The caller makes sure that the steward cancels the others.
    """
    unfinished = (
        select(Job.id)
        .where(condition, Job.state.in_(UNFINISHED_STATES))
        .order_by(Job.id)  # the lock order of `lock_leased_jobs`
        .limit(CANCELLED_PER_TRANSACTION)
        .with_for_update()
    )
    cancelled = session.execute(
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
    return affected_rows(cancelled)


def retry_job(session: Session, job: Job) -> None:
    """Queue a failed or cancelled job again, with its attempts reset.

    Raises:
        Conflict: `job_not_retryable` or `photo_deleted`.
    """
    if job.state not in (JobState.FAILED, JobState.CANCELLED):
        raise Conflict(
            "job_not_retryable",
            f"The job {job.id} is {job.state}; only failed and cancelled jobs can be retried.",
            job_id=str(job.id),
            state=job.state,
        )
    photo = session.get_one(Photo, job.photo_id) if job.photo_id is not None else None
    # A failed reindex job becomes its photo's own job when the generation is activated, and can be
    # retried from then on.
    in_model_change = job.kind == JobKind.REINDEX and (photo is None or photo.job_id != job.id)
    if job.kind in MODEL_CHANGE_JOBS or in_model_change:
        raise Conflict(
            "job_not_retryable",
            "A model change can't be retried. Start a new one: POST /api/v1/vocabularies or "
            "/api/v1/generations.",
            job_id=str(job.id),
        )
    if job.kind == JobKind.ADD_MODEL:
        raise Conflict(
            "job_not_retryable",
            "The uploaded checkpoint is deleted after it was checked. Upload it again: POST "
            "/api/v1/models.",
            job_id=str(job.id),
        )
    if photo is not None:
        if photo.deleted_at is not None:
            raise Conflict("photo_deleted", "The job's photo was deleted.", job_id=str(job.id))
        photo.job_id = job.id
    requeue_job_as_new(job)


def requeue_job_as_new(job: Job, *, keep_result: bool = False) -> None:
    """Reset the job to `queued`, as if it were new.

    A succeeded job that keeps its result succeeds again without a second event for webhooks.
    """
    if job.kind == JobKind.REINDEX:
        # Its generation may be gone: the photo is indexed into the active one.
        job.kind, job.priority, job.generation_id = JobKind.INDEX, Priority.UPLOAD, None
    job.state = JobState.QUEUED
    job.attempts = 0
    job.alone = False
    job.error = None
    if not keep_result:
        job.result = None
    _clear_waiting(job)
    job.run_after = None
    job.progress_done = 0
    job.progress_failed = 0
    job.started_at = None
    job.finished_at = None
    _drop_lease(job)


def cancel_batch(session: Session, job: Job) -> None:
    """Cancel the batch and its unfinished items, as `cancel_batch_items`; searchable photos stay.

    Raises:
        Conflict: `job_finished`.
    """
    cancel_job(job)
    cancel_batch_items(session, job)


def cancel_batch_items(session: Session, job: Job) -> None:
    """Cancel the unfinished items of an ended batch; does nothing for any other job.

    Of its photos' jobs it cancels as many as `cancel_jobs`. The items of the others stay `running`
    until the steward calls it again (`cancel_items_of_ended_batches`).
    """
    if job.kind != JobKind.BATCH:
        return
    own = select(BatchItem.photo_job_id).where(
        BatchItem.job_id == job.id,
        BatchItem.state == JobState.RUNNING,
        BatchItem.already_there.is_(False),  # other uploads created those photos
    )
    cancel_jobs(session, Job.id.in_(own))
    sync_item_states(session, job)
    session.execute(
        update(BatchItem)
        .where(
            BatchItem.job_id == job.id,
            or_(
                BatchItem.state == JobState.QUEUED,
                and_(BatchItem.state == JobState.RUNNING, BatchItem.already_there),
            ),
        )
        .values(state=JobState.CANCELLED)
        .execution_options(synchronize_session=False)
    )


def retry_batch(session: Session, job: Job) -> None:
    """Queue the failed and cancelled items of the batch again whose bytes are still stored.

    The bytes are stored with the photo, or under the object key that the manifest named. Rejected
    files are not stored.

    Raises:
        Conflict: `job_not_retryable`: the batch is unfinished, or no item can be retried.
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
    retried_count = 0
    for begin in range(0, len(items), ITEMS_PER_STATEMENT):
        chunk = items[begin : begin + ITEMS_PER_STATEMENT]
        live_photos = get_live_photos(session, [item.photo_id for item in chunk if item.photo_id])
        for item in chunk:
            photo = live_photos.get(item.photo_id) if item.photo_id else None
            if photo is not None:
                _retry_item_photo(session, photo, item)
            elif from_keys:
                item.state, item.photo_id, item.photo_job_id = JobState.QUEUED, None, None
            else:
                continue
            item.error = None
            retried_count += 1
    if not retried_count:
        raise _batch_not_retryable_error(
            job,
            "has no item that can be retried, because rejected files are not stored. Upload them "
            "again; photos that are already in the map are not described twice",
        )
    session.flush()
    requeue_job_as_new(job)
    job.stage = "store"
    sync_item_states(session, job)


def _retry_item_photo(session: Session, photo: Photo, item: BatchItem) -> None:
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is not None and job.state in (JobState.FAILED, JobState.CANCELLED):
        requeue_job_as_new(job)
    item.state, item.photo_job_id = JobState.RUNNING, photo.job_id


def _batch_not_retryable_error(job: Job, reason: str) -> Conflict:
    return Conflict(
        "job_not_retryable", f"The batch {job.id} {reason}.", job_id=str(job.id), state=job.state
    )
