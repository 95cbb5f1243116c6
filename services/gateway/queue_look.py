"""How many jobs there are in which state, and how old the oldest is: for the figures."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import and_, case, func, literal_column, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from shared.catalog.base import db_now
from shared.catalog.maps import Map
from shared.catalog.session import Catalog
from shared.jobs.table import Job, JobState

QUEUE_POLL_SECONDS = 5.0
POLL_COST_DIVISOR = 20  # a look that takes long is taken seldom: one part in so many of the time
COUNTED_STATES = (JobState.QUEUED, JobState.RUNNING, JobState.FAILED)


@dataclass(frozen=True, slots=True)
class JobCount:
    """The jobs of one kind in one state; `waiting` are those that no worker may take yet."""

    kind: str
    state: str
    count: int
    oldest_seconds: float


class QueueMetrics:
    """A look that is shared by all who ask within LOOK_SECONDS. Thread-safe."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._lock = threading.Lock()
        self._cached: Sequence[JobCount] | None = None
        self._next_poll = 0.0

    def job_counts(self) -> Sequence[JobCount] | None:
        """None while the catalog is away."""
        with self._lock:
            began = time.monotonic()
            if began < self._next_poll:
                return self._cached
            try:
                with self._catalog.read() as session:
                    self._cached = count_jobs(session)
            except SQLAlchemyError:
                self._cached = None
            took = time.monotonic() - began
            self._next_poll = began + max(QUEUE_POLL_SECONDS, POLL_COST_DIVISOR * took)
            return self._cached


def count_jobs(session: Session) -> list[JobCount]:
    """Of all maps. The index of a map's jobs by state serves it: those that succeeded, by far the
    most, are not looked at."""
    state = case((Job.waiting_for.is_not(None), literal_column("'waiting'")), else_=Job.state)
    found = session.execute(
        select(Job.kind, state, func.count(), func.min(Job.created_at), db_now())
        .join_from(Map, Job, and_(Job.map_id == Map.id, Job.state.in_(COUNTED_STATES)))
        .group_by(Job.kind, state)
        .order_by(Job.kind, state)
    )
    return [
        JobCount(kind, now_state, count, max(0.0, (now - oldest).total_seconds()))
        for kind, now_state, count, oldest, now in found
    ]
