"""Trying again what a batch has not brought in."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.photos import Photo, get_live_photos
from shared.errors import Conflict
from shared.jobs.batches import ITEMS_PER_STATEMENT, BatchItem, BatchSource, sync_item_states
from shared.jobs.finish import requeue_job
from shared.jobs.table import UNFINISHED_STATES, Job, JobState


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
