"""Leases of claimed jobs: extending and checking them.

A claim has a lease and a fencing token. A worker that does not extend its lease counts as dead: its
jobs go back to the queue (`shared.jobs.runner`), and its token can no longer commit. Leases use the
database's clock only.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator, Sequence
from uuid import UUID

from sqlalchemy import select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from shared.catalog.database.base import affected_rows, db_now_plus
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import Job, select_locked_job_ids

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
        .where(Job.id.in_(select_locked_job_ids(token)))
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


def lock_leased_job(session: Session, job: Job) -> Job | None:
    """Lock and return the claimed job; None if it was cancelled or taken over meanwhile."""
    return next(iter(lock_leased_jobs(session, get_lease_token(job), [job])), None)
