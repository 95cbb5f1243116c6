"""Messages about jobs, sent after the commit: they wake workers and tell monitors what happened.

The job table is the source of truth: a lost message delays a job by seconds and never loses it; a
duplicate is harmless. Queries have a queue of their own, which workers look at first.
`shared.jobs.celery_messages` sends the messages of separate services.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, Self
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.database.session import Catalog
from shared.catalog.jobs import SINGLE_CLAIM_JOBS, Job, JobKind, Priority, claimable_condition
from shared.catalog.maps import Map
from shared.catalog.photos import Photo


class WakeupQueue(StrEnum):
    QUERY = "placewise.query"  # a client waits for the result
    BULK = "placewise.bulk"  # photos of maps
    MODEL = "placewise.model"  # model changes, added models, reconstructions


def task_name(kind: JobKind) -> str:
    """Return the name of the Celery task of a kind of jobs."""
    return f"placewise.{kind}"


@dataclass(frozen=True, slots=True)
class JobMessage:
    """What a message says about a job: enough for an operator to recognise it."""

    id: UUID
    kind: JobKind
    queue: WakeupQueue
    map: str
    file: str | None
    """Name of the photo, or of the uploaded vocabulary or checkpoint."""

    @classmethod
    def of(cls, job: Job, map_name: str, filename: str | None = None) -> Self:
        """Return the message about a job; the name of a stored photo is not in the job's row."""
        queue = WakeupQueue.QUERY if job.priority >= Priority.QUERY else WakeupQueue.BULK
        if job.kind in SINGLE_CLAIM_JOBS:
            queue = WakeupQueue.MODEL
        filename = filename or (job.params or {}).get("filename")
        return cls(job.id, JobKind(job.kind), queue, map_name, filename)

    @property
    def task(self) -> str:
        return task_name(self.kind)


def read_job_messages(session: Session, job_ids: Sequence[UUID]) -> list[JobMessage]:
    """Return the messages about jobs, in the order in which workers claim them."""
    rows = session.execute(
        select(Job, Map.name, Photo.filename)
        .join(Map, Map.id == Job.map_id)
        .outerjoin(Photo, Photo.id == Job.photo_id)
        .where(Job.id.in_(job_ids))
        .order_by(Job.priority.desc(), Job.id)
    )
    return [JobMessage.of(job, map_name, filename) for job, map_name, filename in rows]


class Wakeups(Protocol):
    """Interface for messages about jobs.

    No method raises or blocks: what they tell is committed already.
    """

    problem: str | None
    """Why messages can't be sent at the moment."""

    def send(self, *jobs: JobMessage) -> None:
        """Wake a worker for queued jobs. Jobs that are not named are announced by the steward."""

    def resend(self, catalog: Catalog) -> int:
        """Send the messages of claimable jobs that have none, and withdraw outdated ones.

        Returns:
            The number of messages sent.
        """

    def report(self, *jobs: Job) -> None:
        """Tell monitors in which state these jobs are; their rows have been read after a commit."""

    def claimed(self, *jobs: JobMessage) -> None:
        """Tell monitors that this worker has claimed these jobs, and withdraw their messages."""

    def started(self, *jobs: Job) -> None:
        """Tell monitors that this worker runs these jobs now."""


class InProcessWakeups:
    """Wakeups of an embedded server: at most one is outstanding.

    Its extractor, in another process, is woken by `wake_extractor`.
    """

    problem: str | None = None

    def __init__(self, wake_extractor: Callable[[], object] = lambda: None) -> None:
        self._event = threading.Event()
        self._wake_extractor = wake_extractor

    def send(self, *jobs: JobMessage) -> None:
        self._event.set()
        self._wake_extractor()

    def resend(self, catalog: Catalog) -> int:
        with catalog.read() as session:
            has_jobs = session.scalar(select(Job.id).where(claimable_condition()).limit(1))
        if has_jobs is None:
            return 0
        self.send()
        return 1

    def report(self, *jobs: Job) -> None:
        """Do nothing: nothing monitors an embedded server."""

    def claimed(self, *jobs: JobMessage) -> None:
        """Do nothing, as `report`."""

    started = report

    def wait(self, seconds: float) -> bool:
        """Block until a wakeup arrives or the timeout expires; True when one arrived."""
        arrived = self._event.wait(seconds)
        self._event.clear()
        return arrived


def report_jobs(catalog: Catalog, wakeups: Wakeups, job_ids: Sequence[UUID]) -> None:
    """Tell monitors in which state these jobs are now."""
    with catalog.read_once() as session:
        wakeups.report(*session.scalars(select(Job).where(Job.id.in_(job_ids))))
