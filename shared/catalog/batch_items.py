"""Batches: one job that imports many photos, and the state of each of its items.

```
            the steward imports it                its photo's own job ends
  QUEUED ─────────────────────────────> RUNNING ───────────────────────────> SUCCEEDED: searchable
     │  its bytes or fields are invalid     │ ────────────────────────────> FAILED
     └──────────> FAILED                    │ the photo was deleted, or its job cancelled
                                            └────────────────────────────> CANCELLED
```
An item becomes RUNNING in the transaction that creates its photo and the photo's job, under the
batch's lease: so each is imported exactly once, whichever process dies. The batch succeeds when
every item has ended, also when some have failed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import StrEnum
from itertools import islice
from typing import Any
from uuid import UUID

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import Base, JsonValue, count_rows, insert_row, partial_index
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, JobState, Priority

ITEMS_PER_STATEMENT = 1000  # rows inserted, or jobs selected, by one statement


class BatchSource(StrEnum):
    """Source of a batch's photos."""

    FILES = "files"  # uploaded files, already in the object store
    KEYS = "keys"  # objects that the user has put into the store
    PREFIX = "prefix"  # all such objects under a prefix, which the steward lists


class BatchItem(Base):
    """A photo of a batch, numbered from 1. Its states are those of jobs."""

    __tablename__ = "batch_items"

    job_id: Mapped[UUID] = mapped_column(
        sa.Uuid, sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True
    )
    number: Mapped[int] = mapped_column(sa.Integer, primary_key=True, autoincrement=False)
    name: Mapped[str] = mapped_column(sa.Text)
    state: Mapped[JobState] = mapped_column(sa.String(20), default=JobState.QUEUED)
    # The object with its bytes; null for an uploaded file that was refused.
    object_key: Mapped[str | None] = mapped_column(sa.Text)
    # The size and hash of an uploaded file.
    source: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    fields: Mapped[dict[str, str]] = mapped_column(JsonValue, default=dict)
    # The line of the manifest with these fields.
    line: Mapped[int | None] = mapped_column(sa.Integer)
    # Either may have been deleted since.
    photo_id: Mapped[UUID | None] = mapped_column(sa.Uuid)
    photo_job_id: Mapped[UUID | None] = mapped_column(sa.Uuid)
    already_there: Mapped[bool] = mapped_column(sa.Boolean, default=False)
    error: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)

    __table_args__ = (
        sa.Index("ix_batch_items_state", "job_id", "state", "number"),
        partial_index("ix_batch_items_object_key", "object_key", only=object_key.is_not(None)),
    )


def create_batch(
    session: Session, map_id: UUID, source: BatchSource, params: dict[str, Any] | None = None
) -> Job:
    """Queue a batch without items."""
    job = Job(
        map_id=map_id,
        kind=JobKind.BATCH,
        params={"source": source, "listed": False, **(params or {})},
        progress_total=0,
    )
    return insert_row(session, job)


def add_batch_items(session: Session, job: Job, items: Iterable[dict[str, Any]]) -> None:
    """Add all items of the batch: columns of BatchItem without `job_id` and `number`."""
    rows = (
        {
            "job_id": job.id,
            "number": number,
            "state": JobState.QUEUED,
            "object_key": None,
            "source": {},
            "fields": {},
            "line": None,
            "already_there": False,
            "error": None,
            **item,
        }
        for number, item in enumerate(items, start=1)
    )
    total = 0
    while chunk := list(islice(rows, ITEMS_PER_STATEMENT)):
        session.execute(sa.insert(BatchItem), chunk)
        total += len(chunk)
    job.params = {**job.params, "listed": True}
    job.progress_total = total
    job.stage = "store"
    job.attempts = 0


def has_batch_items(job: Job) -> bool:
    """Return whether the job is a batch whose items were listed."""
    return job.kind == JobKind.BATCH and bool(job.params["listed"])


def next_queued_items(session: Session, job_id: UUID, limit: int) -> list[BatchItem]:
    """Return the next items to import."""
    return list(
        session.scalars(
            sa.select(BatchItem)
            .where(BatchItem.job_id == job_id, BatchItem.state == JobState.QUEUED)
            .order_by(BatchItem.number)
            .limit(limit)
        )
    )


def list_batch_items(
    session: Session, job_id: UUID, states: list[JobState], limit: int, after: int
) -> list[BatchItem]:
    """List items in their order, up to `limit`, with numbers above `after`; empty `states`: all."""
    statement = sa.select(BatchItem).where(BatchItem.job_id == job_id, BatchItem.number > after)
    if states:
        statement = statement.where(BatchItem.state.in_(states))
    return list(session.scalars(statement.order_by(BatchItem.number).limit(limit)))


def count_queued_photos(session: Session, limit: int) -> int:
    """Count the photos that are queued for the extractors, up to `limit`."""
    waiting = sa.select(Job.id).where(
        Job.state.in_(UNFINISHED_STATES),
        Job.lease_token.is_(None),
        Job.priority >= Priority.BATCH,
        Job.kind == JobKind.INDEX,
        Job.waiting_for.is_(None),
    )
    return count_rows(session, waiting, limit)


def sync_item_states(session: Session, job: Job) -> Counter[JobState]:
    """End items whose photos' jobs have ended, update the progress; return the counts by state."""
    ended = session.execute(
        sa.select(BatchItem.number, Job.state, Job.error)
        .outerjoin(Job, Job.id == BatchItem.photo_job_id)
        .where(
            BatchItem.job_id == job.id,
            BatchItem.state == JobState.RUNNING,
            sa.or_(Job.id.is_(None), Job.state.not_in(UNFINISHED_STATES)),
        )
    ).all()
    if ended:
        session.execute(
            sa.update(BatchItem),
            [
                {
                    "job_id": job.id,
                    "number": number,
                    # A job is deleted with its photo.
                    "state": state or JobState.CANCELLED,
                    "error": error if state == JobState.FAILED else None,
                }
                for number, state, error in ended
            ],
        )
    rows = session.execute(
        sa.select(BatchItem.state, sa.func.count())
        .where(BatchItem.job_id == job.id)
        .group_by(BatchItem.state)
    )
    counts = Counter({JobState(state): count for state, count in rows})
    update_batch_progress(job, counts)
    return counts


def update_batch_progress(job: Job, counts: Counter[JobState]) -> None:
    """Set the job's progress: searchable, failed and all photos."""
    job.progress_done = counts[JobState.SUCCEEDED]
    job.progress_failed = counts[JobState.FAILED]
    job.progress_total = counts.total()


def summarise_batch(session: Session, job: Job, counts: Counter[JobState]) -> dict[str, Any]:
    """Return the result of an ended batch, as photo counts; `ignored` counts other objects."""
    already_there = sa.select(BatchItem.number).where(
        BatchItem.job_id == job.id, BatchItem.state == JobState.SUCCEEDED, BatchItem.already_there
    )
    return {
        "photos": counts.total(),
        "succeeded": counts[JobState.SUCCEEDED],
        "failed": counts[JobState.FAILED],
        "cancelled": counts[JobState.CANCELLED],
        "already_there": count_rows(session, already_there),
        "ignored": job.params.get("ignored", 0),
    }
