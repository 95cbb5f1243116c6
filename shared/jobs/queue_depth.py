"""Queue depth and throughput: bounded counts, and a cache that bounds the cost of polling them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from shared.catalog.database.base import count_rows, db_now, db_now_plus
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, Priority, claimable_condition
from shared.catalog.maps import Map

THROUGHPUT_WINDOW_SECONDS = 60.0
MAX_COUNTED_FINISHED = 100_000  # in THROUGHPUT_WINDOW_SECONDS: above any real throughput
USUAL_JOBS = 50  # whose mean duration is the usual one
STALLED_FACTOR = 5
STALLED_SECONDS = 60.0  # at least

# All but `reindex`: a model change queues every photo of its map, with the lowest priority.
BACKLOG_PRIORITIES = (Priority.UPLOAD, Priority.BATCH, Priority.MODEL_CHANGE, Priority.EVALUATION)


POLL_COST_DIVISOR = 20  # polling takes at most 1/20 of the time: slow polls become rare

T = TypeVar("T")


class PolledValue(Generic[T]):
    """A value that is polled when it is read, but at most once per interval. Thread-safe.

    While one thread polls, the others get the previous value; they wait for the first one.

    Args:
        poll: Returns the value. Its exceptions reach the reader, and the next reader polls again.
        interval_seconds: Minimum time between two polls; longer if a poll is slow.
    """

    _value: T

    def __init__(self, poll: Callable[[], T], interval_seconds: float) -> None:
        self._poll = poll
        self._interval_seconds = interval_seconds
        self._lock = threading.Lock()
        self._next_poll: float | None = None

    def get(self) -> T:
        """Return the value."""
        if self._is_due() and self._lock.acquire(blocking=self._next_poll is None):
            try:
                if self._is_due():  # otherwise another thread has polled meanwhile
                    started = time.monotonic()
                    self._value = self._poll()
                    elapsed = time.monotonic() - started
                    pause = max(self._interval_seconds, POLL_COST_DIVISOR * elapsed)
                    self._next_poll = started + pause
            finally:
                self._lock.release()
        return self._value

    def _is_due(self) -> bool:
        return self._next_poll is None or time.monotonic() >= self._next_poll


@dataclass(frozen=True, slots=True)
class QueueDepth:
    """Jobs that a worker could claim and none has."""

    jobs_by_map: Mapping[str, int]
    """Map name -> number of its jobs, without queries."""
    queries: int
    """Number of query photos of all maps."""
    finished: int
    """Uploads and queries that succeeded or failed in the last THROUGHPUT_WINDOW_SECONDS."""
    oldest_seconds: float = 0.0
    """Age of the oldest job or query that a worker could claim; 0 if there is none."""
    usual_seconds: float = 0.0
    """Mean duration of the last uploads and queries that ended, from the claim."""

    @property
    def finished_per_second(self) -> float:
        return self.finished / THROUGHPUT_WINDOW_SECONDS

    @property
    def is_stalled(self) -> bool:
        """Whether a job has waited for STALLED_FACTOR times the usual, and nothing finishes."""
        patience = max(STALLED_SECONDS, STALLED_FACTOR * self.usual_seconds)
        return not self.finished and self.oldest_seconds > patience

    @property
    def jobs(self) -> int:
        return sum(self.jobs_by_map.values())


def measure_queue_depth(session: Session, limit: int) -> QueueDepth:
    """Count up to `limit` jobs and up to `limit` queries, with the index that claims use."""
    jobs_by_map = _count_by_map(session, BACKLOG_PRIORITIES, limit)
    queries = sum(_count_by_map(session, (Priority.QUERY,), limit).values())
    finished = select(Job.id).where(
        Job.kind.in_((JobKind.INDEX, JobKind.DESCRIBE)),
        Job.finished_at > db_now_plus(-THROUGHPUT_WINDOW_SECONDS),
    )
    return QueueDepth(
        jobs_by_map,
        queries,
        count_rows(session, finished, MAX_COUNTED_FINISHED),
        _oldest_seconds(session),
        _usual_seconds(session),
    )


def _oldest_seconds(session: Session) -> float:
    """Age of the oldest claimable job of an extractor, by the index that claims use."""
    ages = [0.0]
    for priority in Priority:
        of_priority = select(Job.created_at, db_now()).where(
            claimable_condition(), Job.priority == priority
        )
        for created_at, now in session.execute(of_priority.order_by(Job.id).limit(1)):
            ages.append((now - created_at).total_seconds())
    return max(ages)


def _usual_seconds(session: Session) -> float:
    ended = (
        select(Job.started_at, Job.finished_at)
        .where(
            Job.kind.in_((JobKind.INDEX, JobKind.DESCRIBE)),
            Job.started_at.is_not(None),
            Job.finished_at.is_not(None),
        )
        .order_by(Job.finished_at.desc())
        .limit(USUAL_JOBS)
    )
    seconds = [
        (end - begin).total_seconds() for begin, end in session.execute(ended) if begin and end
    ]
    return sum(seconds) / len(seconds) if seconds else 0.0


def _count_by_map(session: Session, priorities: Sequence[Priority], limit: int) -> dict[str, int]:
    """Map name -> claimable jobs of these priorities; counts at most `limit` jobs in total."""
    claimable = (
        select(Job.map_id)
        .where(
            Job.state.in_(UNFINISHED_STATES),
            Job.lease_token.is_(None),
            Job.waiting_for.is_(None),
            Job.priority.in_(priorities),
        )
        .limit(limit)
        .subquery()
    )
    counts = session.execute(
        select(Map.name, func.count())
        .join_from(claimable, Map, Map.id == claimable.c.map_id)
        .group_by(Map.name)
    )
    return {name: count for name, count in counts}  # noqa: C416  (rows, not pairs, to mypy)
