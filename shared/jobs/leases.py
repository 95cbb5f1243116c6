"""Leases: how long a worker is believed to be alive, by the database's clock alone."""

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
    """The token that a claimed job carries."""
    assert job.lease_token is not None, "a claimed job carries a token"
    return job.lease_token


def extend_lease(session: Session, token: UUID, lease_seconds: float) -> bool:
    """Keep what was claimed under `token`; False when all of it has been taken over or ended."""
    touched = session.execute(
        update(Job)
        .where(Job.id.in_(session.scalars(select_locked_job_ids(token)).all()))
        .values(lease_until=db_now_plus(lease_seconds))
        .execution_options(synchronize_session=False)
    )
    return affected_rows(touched) > 0


@contextlib.contextmanager
def maintain_lease(catalog: Catalog, token: UUID, lease_seconds: float) -> Iterator[None]:
    """Extends the lease from a thread while the block runs, three times per lease."""
    done = threading.Event()
    outage = OutageLog(f"lease {token}")

    def keep() -> None:
        while not done.wait(lease_seconds / 3):
            try:
                with catalog.write() as session:
                    if not extend_lease(session, token, lease_seconds):
                        return
            except SQLAlchemyError as error:
                # The lease may run out, and then the token fences the commit.
                outage.record_error(error)

    keeper = threading.Thread(target=keep, name=f"lease-{token}", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        done.set()
        keeper.join()


def lock_leased_jobs(session: Session, token: UUID, jobs: Sequence[Job]) -> list[Job]:
    """Those of the jobs that still carry the token, locked: only these may be finished."""
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
    """Give back what dead workers held; returns how many jobs that were.

    A job that fell with others is marked `alone`: it may be innocent. One that fell alone has
    used an attempt, and after `max_attempts` it is failed. `all_leases` frees all leases, for a
    process that knows that no other worker lives.
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
    """The worker that had the job died, or crashed (`cause`): who is to blame is not known yet.

    What fell in a batch is tried again alone, and no attempt is counted.
    """
    if job.claimed_together == 0:  # nothing had begun that the job could be blamed for
        release_job(job)
        return
    fell_alone = job.claimed_together == 1
    job.attempts += fell_alone
    # A batch goes on without the one photo that may be to blame; its worker sees to that.
    if job.attempts >= max_attempts and not has_batch_items(job):
        fail_job(job, _worker_crash_problem(job, cause))
        abandon_generation(session, job)
        cancel_batch_items(session, job)
        return
    job.alone = job.alone or not fell_alone
    release_job(job)


def _worker_crash_problem(job: Job, cause: str | None) -> dict[str, Any]:
    what = f"crashed ({cause})" if cause else "died"
    return {
        "type": "urn:placewise:problem:worker_fell",
        "title": "The worker fell",
        "status": 500,
        "code": "worker_fell",
        "detail": (
            f"The worker {job.worker} {what} {job.attempts} times while it had only this job. "
            "If the photo is fine, look at the worker's log and memory, then retry the job."
        ),
    }
