"""Ending a batch early, with what of it has not ended."""

from __future__ import annotations

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from shared.jobs.batches import BatchItem, sync_item_states
from shared.jobs.finish import cancel_job, cancel_jobs
from shared.jobs.table import UNFINISHED_STATES, Job, JobKind, JobState


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
