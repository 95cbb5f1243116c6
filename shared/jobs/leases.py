"""Leases of claimed jobs: extending, checking and reclaiming them.

A claim has a lease and a fencing token. A worker that does not extend its lease counts as dead; its
jobs go back to the queue, and its token can no longer commit. Leases use the database's clock only.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator, Sequence
from typing import Any
from uuid import UUID

from sqlalchemy import select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from shared.catalog.base import affected_rows, db_now, db_now_plus
from shared.catalog.batch_items import has_batch_items
from shared.catalog.database_errors import OutageLog
from shared.catalog.jobs import Job, select_locked_job_ids
from shared.catalog.session import Catalog
from shared.jobs.model_changes import abandon_generation
from shared.jobs.transitions import cancel_batch_items, fail_job, release_job

log = logging.getLogger(__name__)


def get_lease_token(job: Job) -> UUID:
    """Return the fencing token of a claimed job."""
    assert job.lease_token is not None, "a claimed job has a token"
    return job.lease_token


def extend_lease(session: Session, token: UUID, lease_seconds: float) -> bool:
    """Extend the lease of the jobs claimed under `token`; False when none of them is left.

    A job is no longer under the token once another worker took it over, or once it ended.
    """
    updated = session.execute(
        update(Job)
        .where(Job.id.in_(session.scalars(select_locked_job_ids(token)).all()))
        .values(lease_until=db_now_plus(lease_seconds))
        .execution_options(synchronize_session=False)
    )
    return affected_rows(updated) > 0


@contextlib.contextmanager
def maintain_lease(catalog: Catalog, token: UUID, lease_seconds: float) -> Iterator[None]:
    """Extend the lease from a thread while the block runs, three times per lease period."""
    done = threading.Event()
    outage = OutageLog(f"lease {token}")

    def renew() -> None:
        while not done.wait(lease_seconds / 3):
            try:
                with catalog.write() as session:
                    if not extend_lease(session, token, lease_seconds):
                        return
            except SQLAlchemyError as error:
                # If the lease expires meanwhile, the token prevents the commit.
                outage.record_error(error)

    renewer = threading.Thread(target=renew, name=f"lease-{token}", daemon=True)
    renewer.start()
    try:
        yield
    finally:
        done.set()
        renewer.join()


def lock_leased_jobs(session: Session, token: UUID, jobs: Sequence[Job]) -> list[Job]:
    """Lock and return the jobs that are still under the token: only these may be finished."""
    return list(
        session.scalars(
            select(Job)
            .where(Job.id.in_([job.id for job in jobs]), Job.lease_token == token)
            .order_by(Job.id)
            .with_for_update()
            .execution_options(populate_existing=True)
        )
    )


def reclaim_expired_leases(session: Session, max_attempts: int, *, all_leases: bool = False) -> int:
    """Return the jobs of dead workers to the queue, or fail them after `max_attempts`.

    Args:
        session: The session of a write transaction.
        max_attempts: Number of crashes after which a job that ran alone fails. A job that was in a
            batch of several is marked `alone` instead, because another one may be the cause.
        all_leases: Reclaim also leases that have not expired, for a process that knows that no
            other worker runs.

    Returns:
        The number of jobs reclaimed.
    """
    expired = select(Job).where(Job.lease_token.is_not(None))
    if not all_leases:
        expired = expired.where(Job.lease_until < db_now())
    jobs = session.scalars(expired.order_by(Job.id).with_for_update(skip_locked=True)).all()
    for job in jobs:
        handle_worker_crash(session, job, max_attempts, cause=None)
    return len(jobs)


def handle_worker_crash(
    session: Session, job: Job, max_attempts: int, *, cause: str | None
) -> None:
    """Retry or fail a job whose worker died (`cause` is None) or raised an exception (its name).

    A job that was in a batch of several is retried alone without counting an attempt, to isolate
    the job that crashed the worker. A job that ran alone fails after `max_attempts`.
    """
    if job.claimed_together == 0:  # not started: the job can't be the cause
        release_job(job)
        return
    ran_alone = job.claimed_together == 1
    job.attempts += ran_alone
    # An upload batch continues without the photo that may be the cause: see BatchWorker.
    if job.attempts >= max_attempts and not has_batch_items(job):
        fail_job(job, _worker_crash_problem(job, cause))
        abandon_generation(session, job)
        cancel_batch_items(session, job)
        return
    job.alone = job.alone or not ran_alone
    release_job(job)


def _worker_crash_problem(job: Job, cause: str | None) -> dict[str, Any]:
    event = f"crashed ({cause})" if cause else "died"
    return {
        "type": "urn:placewise:problem:worker_fell",
        "title": "The worker crashed",
        "status": 500,
        "code": "worker_fell",
        "detail": (
            f"The worker {job.worker} {event} {job.attempts} times while it ran only this job. "
            "If the photo is valid, check the worker's log and memory, then retry the job."
        ),
    }
