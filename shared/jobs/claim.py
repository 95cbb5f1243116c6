"""Claiming jobs: leases a batch of queued jobs that one forward pass can serve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from uuid import UUID

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from shared.catalog.database.base import Condition, db_now, db_now_plus
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
    """Claim claimable jobs of one kind, map and generation, under one new lease token.

    The first job by (priority, age) decides the kind, map and generation. Jobs locked by other
    workers are skipped (`FOR UPDATE SKIP LOCKED`; SQLite has a single writer). A job that is marked
    `alone` or is one of SINGLE_CLAIM_JOBS is claimed as a batch of one.

    Args:
        session: The session of a write transaction.
        worker: Name of the worker, stored with the jobs.
        alone: Whether to claim jobs that have to be retried alone.
        started: False for a worker that begins with steps that can't crash it (reading, decoding):
            if it dies before it calls `mark_started`, the jobs are not blamed.

    Returns:
        The claimed jobs; empty when there are none.
    """
    order = (Job.priority.desc(), Job.id)
    conditions = claim_conditions(kinds, min_priority, alone)
    head = session.scalar(
        select(Job).where(*conditions).order_by(*order).limit(1).with_for_update(skip_locked=True)
    )
    if head is None:
        return []
    batch = [head]
    if not head.alone and head.kind not in SINGLE_CLAIM_JOBS and limit > 1:
        batch += session.scalars(
            select(Job)
            .where(
                *conditions,
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
    # The database has set the times: all jobs are refreshed by the same statement.
    session.scalars(
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
        .returning(Job)
        .execution_options(synchronize_session=False, populate_existing=True)
    ).all()
    return batch


def fair_batch_size(waiting: int, workers: int, limit: int) -> int:
    """Return how many jobs a worker claims, so that the workers share a burst.

    Each takes half of its share of what waits (guided self-scheduling), at least an eighth of
    `limit`: a worker that claims first leaves enough for those that come a moment later.
    """
    if workers < 2:
        return limit
    return min(limit, max(math.ceil(waiting / (2 * workers)), limit // 8, 1))


def mark_started(session: Session, token: UUID, job_count: int) -> None:
    """Record that the `job_count` jobs under the token run: they may be the cause of a crash."""
    session.execute(
        update(Job)
        .where(Job.id.in_(select_locked_job_ids(token)))
        .values(claimed_together=job_count)
        .execution_options(synchronize_session=False)
    )


def claim_conditions(
    kinds: Sequence[JobKind], min_priority: int | None, alone: bool
) -> list[Condition]:
    """Return the conditions on the jobs that `claim_jobs` with the same arguments finds."""
    conditions = [claimable_condition(kinds)]
    if min_priority is not None:
        conditions.append(Job.priority >= min_priority)
    if not alone:
        conditions.append(Job.alone.is_(False))
    return conditions
