"""Batches: one job that brings in many photos, and what has become of each of them.

```
            the steward brings it in              its photo's own job ends
  QUEUED ─────────────────────────────> RUNNING ───────────────────────────> SUCCEEDED: searchable
     │  its bytes or fields are refused     │ ────────────────────────────> FAILED
     └──────────> FAILED                    │ the photo was deleted, or its job cancelled
                                            └────────────────────────────> CANCELLED
```
An item moves to RUNNING in the transaction that makes its photo and that photo's job, under the
batch's lease: so each is brought in once, whoever is killed. The batch succeeds when every item
has ended, also when some have failed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import StrEnum
from itertools import islice
from typing import Any
from uuid import UUID

from sqlalchemy import (
    Boolean,
    ForeignKey,
    Index,
    Integer,
    String,
    Text,
    Uuid,
    func,
    insert,
    or_,
    select,
    update,
)
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue
from shared.catalog.generations import active_generation
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, JobState, Priority, WaitingFor
from shared.catalog.maps import lock_map
from shared.ids import new_id

ITEMS_PER_STATEMENT = 1000  # rows written by one statement, jobs looked up by one


class BatchSource(StrEnum):
    """Where a batch's photos come from."""

    FILES = "files"  # uploaded one by one: they lie in the object store already
    ARCHIVE = "archive"  # members of an uploaded archive
    KEYS = "keys"  # objects that others have put into the store
    PREFIX = "prefix"  # all such objects below a prefix, which the steward lists


class BatchItem(Base):
    """One photo of a batch, by its number from 1. `state` is that of jobs."""

    __tablename__ = "batch_items"

    job_id: Mapped[UUID] = mapped_column(
        Uuid, ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True
    )
    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    name: Mapped[str] = mapped_column(Text)
    state: Mapped[JobState] = mapped_column(String(20), default=JobState.QUEUED)
    # The object that its bytes lie in; null for a member of an archive.
    object_key: Mapped[str | None] = mapped_column(Text)
    # Where in the archive it lies, or what is known of the uploaded file.
    source: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    fields: Mapped[dict[str, str]] = mapped_column(JsonValue, default=dict)
    # The line of the manifest that says these fields.
    line: Mapped[int | None] = mapped_column(Integer)
    # Either may be gone by now.
    photo_id: Mapped[UUID | None] = mapped_column(Uuid)
    photo_job_id: Mapped[UUID | None] = mapped_column(Uuid)
    already_there: Mapped[bool] = mapped_column(Boolean, default=False)
    error: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)

    __table_args__ = (
        Index("ix_batch_items_state", "job_id", "state", "number"),
        Index(
            "ix_batch_items_object_key",
            "object_key",
            postgresql_where=object_key.is_not(None),
            sqlite_where=object_key.is_not(None),
        ),
    )


def create_batch(
    session: Session, map_id: UUID, source: BatchSource, params: dict[str, Any] | None = None
) -> Job:
    """A queued batch without items."""
    job = Job(
        id=new_id(),
        map_id=map_id,
        kind=JobKind.BATCH,
        priority=Priority.BATCH,
        params={"source": source, "listed": False, **(params or {})},
        progress_total=0,
    )
    session.add(job)
    session.flush()
    return job


def add_batch_items(session: Session, job: Job, items: Iterable[dict[str, Any]]) -> None:
    """All the batch's items at once: columns of BatchItem without `job_id` and `number`."""
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
    while some := list(islice(rows, ITEMS_PER_STATEMENT)):
        session.execute(insert(BatchItem), some)
        total += len(some)
    job.params = {**job.params, "listed": True}
    job.progress_total = total
    job.stage = "store"
    job.attempts = 0


def has_batch_items(job: Job) -> bool:
    """Is it a batch that has its items?"""
    return job.kind == JobKind.BATCH and bool(job.params["listed"])


def next_queued_items(session: Session, job_id: UUID, limit: int) -> list[BatchItem]:
    """The next items to bring in."""
    return list(
        session.scalars(
            select(BatchItem)
            .where(BatchItem.job_id == job_id, BatchItem.state == JobState.QUEUED)
            .order_by(BatchItem.number)
            .limit(limit)
        )
    )


def list_batch_items(
    session: Session, job_id: UUID, states: list[JobState], limit: int, after: int
) -> list[BatchItem]:
    """In their order, up to `limit`, behind the number `after`; no states mean "any"."""
    wanted = select(BatchItem).where(BatchItem.job_id == job_id, BatchItem.number > after)
    if states:
        wanted = wanted.where(BatchItem.state.in_(states))
    return list(session.scalars(wanted.order_by(BatchItem.number).limit(limit)))


def count_queued_photos(session: Session, limit: int) -> int:
    """How many photos the extractors have before them, counted up to `limit`.

    Those that wait for a vocabulary are not: more of them may be what makes one.
    """
    waiting = (
        select(Job.id)
        .where(
            Job.state.in_(UNFINISHED_STATES),
            Job.lease_token.is_(None),
            Job.priority >= Priority.BATCH,
            Job.kind == JobKind.INDEX,
            Job.waiting_for.is_(None),
        )
        .limit(limit)
    )
    return session.scalar(select(func.count()).select_from(waiting.subquery())) or 0


def sync_item_states(session: Session, job: Job) -> Counter[JobState]:
    """Let items end as their photos' jobs have ended, and note the progress; counts by state."""
    ended = session.execute(
        select(BatchItem.number, Job.state, Job.error)
        .outerjoin(Job, Job.id == BatchItem.photo_job_id)
        .where(
            BatchItem.job_id == job.id,
            BatchItem.state == JobState.RUNNING,
            or_(Job.id.is_(None), Job.state.not_in(UNFINISHED_STATES)),
        )
    ).all()
    if ended:
        session.execute(
            update(BatchItem),
            [
                {
                    "job_id": job.id,
                    "number": number,
                    # A job goes when its photo was deleted.
                    "state": state or JobState.CANCELLED,
                    "error": error if state == JobState.FAILED else None,
                }
                for number, state, error in ended
            ],
        )
    counted = session.execute(
        select(BatchItem.state, func.count())
        .where(BatchItem.job_id == job.id)
        .group_by(BatchItem.state)
    )
    counts = Counter({JobState(state): count for state, count in counted})
    update_batch_progress(job, counts)
    return counts


def update_batch_progress(job: Job, counts: Counter[JobState]) -> None:
    """What `progress` says: searchable photos, failed ones, all."""
    job.progress_done = counts[JobState.SUCCEEDED]
    job.progress_failed = counts[JobState.FAILED]
    job.progress_total = counts.total()


def summarise_batch(session: Session, job: Job, counts: Counter[JobState]) -> dict[str, Any]:
    """What an ended batch has come to, in photos; `ignored` counts an archive's other members."""
    already_there = session.scalar(
        select(func.count())
        .select_from(BatchItem)
        .where(
            BatchItem.job_id == job.id,
            BatchItem.state == JobState.SUCCEEDED,
            BatchItem.already_there,
        )
    )
    return {
        "photos": counts.total(),
        "succeeded": counts[JobState.SUCCEEDED],
        "failed": counts[JobState.FAILED],
        "cancelled": counts[JobState.CANCELLED],
        "already_there": already_there,
        "ignored": job.params.get("ignored", 0),
    }


def is_waiting_for_vocabulary(session: Session, job: Job) -> bool:
    """Do all running items wait for a vocabulary that the map still lacks? Call it under the map's
    lock: whoever brings one wakes what waits by then."""
    if active_generation(session, job.map_id) is not None:
        return False
    other = (
        select(BatchItem.number)
        .join(Job, Job.id == BatchItem.photo_job_id)
        .where(
            BatchItem.job_id == job.id,
            BatchItem.state == JobState.RUNNING,
            or_(Job.waiting_for.is_(None), Job.waiting_for != WaitingFor.VOCABULARY),
        )
        .limit(1)
    )
    return session.scalar(other) is None


def lock_batch(session: Session, job: Job, token: UUID) -> Job | None:
    """The batch if it still carries the token, both rows locked in the order of everyone."""
    lock_map(session, job.map_id)
    return session.scalar(
        select(Job)
        .where(Job.id == job.id, Job.lease_token == token)
        .with_for_update()
        .execution_options(populate_existing=True)
    )
