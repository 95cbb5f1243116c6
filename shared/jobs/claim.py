"""Taking work: a batch of jobs that one forward pass can serve."""

from __future__ import annotations

from collections.abc import Sequence
from uuid import UUID

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from shared.catalog.base import Condition, db_now, db_now_plus
from shared.catalog.jobs import (
    EXTRACTOR_JOBS,
    SINGLE_CLAIM_JOBS,
    Job,
    JobKind,
    JobState,
    claimable_condition,
    select_locked_job_ids,
)
from shared.ids import new_id


def claim_jobs(
    session: Session,
    *,
    worker: str,
    limit: int,
    lease_seconds: float,
    kinds: Sequence[JobKind] = EXTRACTOR_JOBS,
    min_priority: int | None = None,
    alone: bool = True,
    started: bool = True,
) -> list[Job]:
    """Up to `limit` claimable jobs of one kind, map and generation, leased under one fresh token.

    The first by (priority, age) decides which; jobs that other workers hold are passed over
    (`FOR UPDATE SKIP LOCKED`; SQLite has one writer). A job marked `alone` and one of LONE_JOBS
    come as a batch of one. Jobs below `min_priority` are left, and without `alone` those that
    have to be tried alone. A worker that will first do what can't harm it (read, decode) says so
    with `begun=False`, and calls `begin` after that.
    """
    order = (Job.priority.desc(), Job.id)
    wanted = _claim_conditions(kinds, min_priority, alone)
    head = session.scalar(
        select(Job).where(*wanted).order_by(*order).limit(1).with_for_update(skip_locked=True)
    )
    if head is None:
        return []
    batch = [head]
    if not head.alone and head.kind not in SINGLE_CLAIM_JOBS and limit > 1:
        batch += session.scalars(
            select(Job)
            .where(
                *wanted,
                Job.id != head.id,
                Job.alone.is_(False),
                Job.kind == head.kind,
                Job.map_id == head.map_id,
                Job.generation_id.is_not_distinct_from(head.generation_id),
            )
            .order_by(*order)
            .limit(limit - 1)
            .with_for_update(skip_locked=True)
        )
    session.execute(
        update(Job)
        .where(Job.id.in_([job.id for job in batch]))
        .values(
            state=JobState.RUNNING,
            worker=worker,
            claimed_together=len(batch) if started else 0,
            lease_token=new_id(),
            lease_until=db_now_plus(lease_seconds),
            run_after=None,
            started_at=func.coalesce(Job.started_at, db_now()),
        )
        .execution_options(synchronize_session=False)
    )
    # One statement for all of them: the claim's times and token are the database's.
    session.scalars(
        select(Job)
        .where(Job.id.in_([job.id for job in batch]))
        .execution_options(populate_existing=True)
    ).all()
    return batch


def has_claimable_jobs(
    session: Session, kinds: Sequence[JobKind], min_priority: int | None = None, *, alone: bool
) -> bool:
    """Is there something for `claim` with the same arguments?"""
    found = session.scalar(
        select(Job.id).where(*_claim_conditions(kinds, min_priority, alone)).limit(1)
    )
    return found is not None


def mark_started(session: Session, token: UUID, job_count: int) -> None:
    """From here on the `job_count` jobs under the token may be to blame if the worker falls."""
    session.execute(
        update(Job)
        .where(Job.id.in_(session.scalars(select_locked_job_ids(token)).all()))
        .values(claimed_together=job_count)
        .execution_options(synchronize_session=False)
    )


def _claim_conditions(
    kinds: Sequence[JobKind], least_priority: int | None, alone: bool
) -> list[Condition]:
    wanted = [claimable_condition(kinds)]
    if least_priority is not None:
        wanted.append(Job.priority >= least_priority)
    if not alone:
        wanted.append(Job.alone.is_(False))
    return wanted
