"""The jobs table: kinds, priorities, state machine and queries.

```
            claim (lease + token)                succeed, with a valid token
  QUEUED ───────────────────────────> RUNNING ───────────────────────────────────> SUCCEEDED
   ^  ^ │                              │ │ │ └──── the photo or the request is invalid ───> FAILED
   │  │ │                              │ │ └── requeue: a slice ended, or a dependency is
   │  │ │ cancel                       │ │     unavailable (no attempt counted) ──> QUEUED, or
   │  │ └─────────> CANCELLED <────────┘ │     RUNNING without a lease for a checkpointed job
   │  │                 │    cancel      │
   │  └──── retry ──────┴──── FAILED     │ the lease expires: the worker died
   │                                     v
   ├──── not started (no step that could crash the worker): unchanged
   └──── in a batch: marked `alone`, retried one by one, no attempt counted
         alone: attempts + 1; at `max_attempts` ──────────────────────────────────> FAILED
```

A job is claimable when it is unfinished, has no lease, waits for nothing (`waiting_for`) and
`run_after` has passed. Every claim writes a new `lease_token` (a fencing token). A worker may only
finish jobs that still have its token: after another worker took them over, it can't commit. The
jobs of a batch share one token.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum, StrEnum
from typing import Any
from uuid import UUID

from sqlalchemy import Boolean, ForeignKey, Index, Integer, Select, String, Uuid, and_, or_, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Condition,
    Entity,
    JsonValue,
    UtcDateTime,
    db_now,
    db_now_plus,
    get_in_map,
    list_newest,
    partial_index,
)
from shared.enums import JobState as JobState
from shared.telemetry.request_ids import MAX_REQUEST_ID_CHARACTERS, current_request_id

UNFINISHED_STATES = (JobState.QUEUED, JobState.RUNNING)


class JobKind(StrEnum):
    INDEX = "index"  # describe a stored photo into the active generation
    REINDEX = "reindex"  # describe a stored photo into one generation that is being built
    DESCRIBE = "describe"  # describe a query photo that is not stored
    FIT = "fit"  # fit a vocabulary on the map's photos and switch to it
    IMPORT = "import_vocabulary"  # check a vocabulary file and switch to it
    SWITCH = "switch"  # switch to a vocabulary that the map already has
    PCA = "pca"  # fit PCA whitening on the map's descriptors and switch to shorter ones
    ADD_MODEL = "add_model"  # check a checkpoint and register it as a model, for any map
    EVALUATE = "evaluate"  # search the map with photos whose place is known; compute recall
    RECONSTRUCT = "reconstruct"  # reconstruct the map's photos (`shared.catalog.reconstructions`)
    SYNC_LIBRARY = "sync_library"  # bring the map up to date with a photo library
    BATCH = "batch"  # import many photos, each with its own job (`shared.catalog.batch_items`)


class RunBy(StrEnum):
    """What claims and runs the jobs of a kind."""

    EXTRACTOR = "extractor"  # between two batches of photos
    FIT_WORKER = "fit worker"  # a thread of the extractor, in child processes beside the photos
    STEWARD = "steward"  # jobs that need only search


class Priority(IntEnum):
    """Higher is claimed first; within one priority, older is claimed first."""

    QUERY = 100  # a client waits for the result
    UPLOAD = 50
    BATCH = 40  # also of its photos, so that a single upload does not wait for thousands
    MODEL_CHANGE = 20
    REINDEX = 10
    EVALUATION = 5


@dataclass(frozen=True, slots=True)
class JobType:
    """How the jobs of a kind are shown and run."""

    title: str  # in plain words, for the page and the command
    priority: Priority  # of its jobs, unless they have another one
    run_by: RunBy = RunBy.EXTRACTOR
    in_batches: bool = False  # claimed together: each is the description of one photo
    changes_model: bool = False  # one at a time in each map, in slices, up to a switch
    in_slices: bool = False  # between two slices the job is `running` without a lease
    has_upload: bool = False  # parameter `object_key` is the key of an upload, or None
    on_status_page: bool = True  # among the newest jobs


JOB_TYPES = {
    JobKind.INDEX: JobType("Photo", Priority.UPLOAD, in_batches=True),
    JobKind.REINDEX: JobType(
        "Photo for a new model", Priority.REINDEX, in_batches=True, on_status_page=False
    ),
    JobKind.DESCRIBE: JobType("Query photo", Priority.QUERY, in_batches=True, on_status_page=False),
    JobKind.FIT: JobType(
        "Improving the map", Priority.MODEL_CHANGE, RunBy.FIT_WORKER, changes_model=True
    ),
    JobKind.IMPORT: JobType("Vocabulary import", Priority.MODEL_CHANGE, changes_model=True),
    JobKind.SWITCH: JobType("Switch", Priority.MODEL_CHANGE, changes_model=True),
    JobKind.PCA: JobType("PCA", Priority.MODEL_CHANGE, RunBy.FIT_WORKER, changes_model=True),
    JobKind.ADD_MODEL: JobType("New model", Priority.MODEL_CHANGE, has_upload=True),
    JobKind.EVALUATE: JobType("Evaluation", Priority.EVALUATION, RunBy.STEWARD),
    JobKind.RECONSTRUCT: JobType(
        "Reconstruction", Priority.MODEL_CHANGE, RunBy.FIT_WORKER, has_upload=True
    ),
    JobKind.SYNC_LIBRARY: JobType("Photo library", Priority.BATCH, RunBy.STEWARD),
    JobKind.BATCH: JobType("Batch", Priority.BATCH, RunBy.STEWARD, in_slices=True),
}


def _kinds(condition: Callable[[JobType], bool]) -> tuple[JobKind, ...]:
    return tuple(kind for kind, job_type in JOB_TYPES.items() if condition(job_type))


DRAINED_JOBS = _kinds(lambda kind: kind.run_by == RunBy.EXTRACTOR)
FIT_WORKER_JOBS = _kinds(lambda kind: kind.run_by == RunBy.FIT_WORKER)
EXTRACTOR_JOBS = DRAINED_JOBS + FIT_WORKER_JOBS
SINGLE_CLAIM_JOBS = _kinds(lambda kind: kind.run_by != RunBy.STEWARD and not kind.in_batches)
MODEL_CHANGE_JOBS = _kinds(lambda kind: kind.changes_model)
CHECKPOINTED_JOBS = _kinds(lambda kind: kind.changes_model or kind.in_slices)
UPLOAD_JOBS = _kinds(lambda kind: kind.has_upload)
STATUS_PAGE_JOBS = _kinds(lambda kind: kind.on_status_page)

# Retention of query photos: long enough for a client that polls, and for the background of a track;
# short, because nobody has chosen to store these photos.
QUERY_TTL_SECONDS = 3600.0


class WaitingFor(StrEnum):
    DESCRIPTORS = "descriptors"  # every photo has to be described into the new generation
    SEARCH = "search"  # every live search worker has to load the new generation
    DISK_SPACE = "disk_space"  # a batch: the disk or the bucket is full


def _ready_condition(state: Any, lease_token: Any, waiting_for: Any) -> Condition:
    """The time-independent part of `claimable_condition`, for partial indexes."""
    return and_(state.in_(UNFINISHED_STATES), lease_token.is_(None), waiting_for.is_(None))


class Job(Entity):
    """A job. See the module's docstring for `state`, `attempts` and the lease."""

    __tablename__ = "jobs"

    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"))
    kind: Mapped[JobKind] = mapped_column(String(30))
    state: Mapped[JobState] = mapped_column(String(20), default=JobState.QUEUED)
    priority: Mapped[int] = mapped_column(
        Integer, default=lambda row: JOB_TYPES[row.get_current_parameters()["kind"]].priority
    )
    photo_id: Mapped[UUID | None] = mapped_column(Uuid, ForeignKey("photos.id"), index=True)
    generation_id: Mapped[UUID | None] = mapped_column(Uuid, ForeignKey("generations.id"))
    params: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    stage: Mapped[str | None] = mapped_column(String(30))
    waiting_for: Mapped[str | None] = mapped_column(String(30))
    # Names of the search workers that a job waits for, once that takes long.
    awaited: Mapped[list[str] | None] = mapped_column(JsonValue)
    progress_done: Mapped[int] = mapped_column(Integer, default=0)
    progress_total: Mapped[int] = mapped_column(Integer, default=1)
    progress_failed: Mapped[int] = mapped_column(Integer, default=0)
    result: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    error: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    attempts: Mapped[int] = mapped_column(Integer, default=0)
    alone: Mapped[bool] = mapped_column(Boolean, default=False)
    # How many are worked on at once; 0 until what could harm the worker has begun.
    claimed_together: Mapped[int] = mapped_column(Integer, default=0)
    worker: Mapped[str | None] = mapped_column(String(200))
    lease_token: Mapped[UUID | None] = mapped_column(Uuid)
    lease_until: Mapped[datetime | None] = mapped_column(UtcDateTime)
    run_after: Mapped[datetime | None] = mapped_column(UtcDateTime)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    started_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    finished_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    # Of the request, or of the job, that created it: links logs.
    request_id: Mapped[str | None] = mapped_column(
        String(MAX_REQUEST_ID_CHARACTERS), default=current_request_id
    )

    __table_args__ = (
        # Claiming: first the job with the highest priority, then the rest of its batch.
        partial_index(
            "ix_jobs_ready",
            priority.desc(),
            "id",
            only=_ready_condition(state, lease_token, waiting_for),
        ),
        partial_index(
            "ix_jobs_ready_batch",
            "kind",
            "map_id",
            priority.desc(),
            "id",
            only=_ready_condition(state, lease_token, waiting_for),
        ),
        partial_index("ix_jobs_leased", "lease_until", only=lease_token.is_not(None)),
        partial_index(
            "ix_jobs_waiting", "map_id", "waiting_for", "id", only=waiting_for.is_not(None)
        ),
        # Lists without a kind exclude reindex jobs, of which a model change has very many.
        partial_index("ix_jobs_map_listed", "map_id", "id", only=kind != JobKind.REINDEX),
        partial_index("ix_jobs_finished", "finished_at", only=finished_at.is_not(None)),
        partial_index("ix_jobs_asked", "created_at", only=kind == JobKind.DESCRIBE),
        Index("ix_jobs_map_state", "map_id", "state", "id"),
        Index("ix_jobs_map_kind", "map_id", "kind", "id"),
        Index("ix_jobs_kind_waiting", "kind", "waiting_for"),
        Index("ix_jobs_generation_state", "generation_id", "state"),
    )


def claimable_condition(kinds: Sequence[JobKind] = EXTRACTOR_JOBS) -> Condition:
    """Condition for jobs of these kinds that a worker may claim now."""
    return and_(
        Job.state.in_(UNFINISHED_STATES),
        Job.kind.in_(kinds),
        Job.lease_token.is_(None),
        Job.waiting_for.is_(None),
        or_(Job.run_after.is_(None), Job.run_after <= db_now()),
    )


def is_job_overdue(session: Session, seconds: float) -> bool:
    """Return whether a job that an extractor may claim was created more than `seconds` ago."""
    overdue = select(Job.id).where(claimable_condition(), Job.created_at < db_now_plus(-seconds))
    return session.scalar(overdue.limit(1)) is not None


def select_locked_job_ids(token: UUID) -> Select[UUID]:
    """Select the ids of the jobs under the token and lock them, ordered by id.

    Every statement locks jobs in this order: the thread that extends the lease and the transaction
    that finishes the jobs would deadlock otherwise.
    """
    return select(Job.id).where(Job.lease_token == token).order_by(Job.id).with_for_update()


def get_job(session: Session, map_id: UUID, job_id: UUID, *, lock: bool = False) -> Job:
    """Return a job of the map; NotFound (`job_not_found`)."""
    return get_in_map(session, Job, map_id, job_id, lock=lock)


def list_jobs(
    session: Session,
    map_id: UUID,
    states: Sequence[JobState],
    kinds: Sequence[JobKind],
    limit: int,
    before: UUID | None,
) -> list[Job]:
    """List jobs of the map, newest first, up to `limit`.

    Args:
        states: Empty for all.
        kinds: Empty for all but reindex jobs.
    """
    conditions = [
        Job.map_id == map_id,
        Job.kind.in_(kinds) if kinds else Job.kind != JobKind.REINDEX,
    ]
    if states:
        conditions.append(Job.state.in_(states))
    return list_newest(session, Job, *conditions, limit=limit, before=before)
