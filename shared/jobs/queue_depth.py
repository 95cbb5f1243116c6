"""How much work waits, and how fast it gets done: counted within bounds, never in full."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from shared.catalog.base import db_now_plus
from shared.catalog.jobs import QUERY_JOBS, UNFINISHED_STATES, Job, JobKind, Priority
from shared.catalog.maps import Map

THROUGHPUT_WINDOW_SECONDS = 60.0
MAX_COUNTED_FINISHED = 100_000  # counted in RATE_SECONDS at most: nobody is faster

# All but `reindex`: a model change queues every photo of its map, behind everything that is asked.
BACKLOG_PRIORITIES = (Priority.UPLOAD, Priority.BATCH, Priority.MODEL_CHANGE, Priority.EVALUATION)


@dataclass(frozen=True, slots=True)
class QueueDepth:
    """Jobs that a worker could take and none has; those that wait for a vocabulary are no queue."""

    jobs_by_map: Mapping[str, int]
    """Name of a map -> its jobs, without queries."""
    queries: int
    """Query photos and comparisons, of all maps."""
    finished_per_second: float
    """Uploads and queries that ended of late, well or not."""

    @property
    def jobs(self) -> int:
        return sum(self.jobs_by_map.values())


def measure_queue_depth(session: Session, limit: int) -> QueueDepth:
    """Counts `limit` jobs and as many queries at most, by the index that workers claim by."""
    of_maps = _count(session, BACKLOG_PRIORITIES, limit)
    queries = sum(_count(session, (Priority.QUERY,), limit).values())
    finished = (
        select(Job.id)
        .where(
            Job.kind.in_((JobKind.INDEX, *QUERY_JOBS)),
            Job.finished_at > db_now_plus(-THROUGHPUT_WINDOW_SECONDS),
        )
        .limit(MAX_COUNTED_FINISHED)
        .subquery()
    )
    done = session.scalar(select(func.count()).select_from(finished)) or 0
    return QueueDepth(of_maps, queries, done / THROUGHPUT_WINDOW_SECONDS)


def _count(session: Session, priorities: Sequence[Priority], most: int) -> dict[str, int]:
    """Jobs of these priorities by their map's name, `most` in all."""
    some = (
        select(Job.map_id)
        .where(
            Job.state.in_(UNFINISHED_STATES),
            Job.lease_token.is_(None),
            Job.waiting_for.is_(None),
            Job.priority.in_(priorities),
        )
        .limit(most)
        .subquery()
    )
    counted = session.execute(
        select(Map.name, func.count())
        .join_from(some, Map, Map.id == some.c.map_id)
        .group_by(Map.name)
    )
    return {name: count for name, count in counted}  # noqa: C416  (rows, not pairs, to mypy)
