"""Queue depth and throughput, measured with bounded counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from shared.catalog.base import db_now_plus
from shared.catalog.jobs import QUERY_JOBS, UNFINISHED_STATES, Job, JobKind, Priority
from shared.catalog.maps import Map

THROUGHPUT_WINDOW_SECONDS = 60.0
MAX_COUNTED_FINISHED = 100_000  # in THROUGHPUT_WINDOW_SECONDS: above any real throughput

# All but `reindex`: a model change queues every photo of its map, with the lowest priority.
BACKLOG_PRIORITIES = (Priority.UPLOAD, Priority.BATCH, Priority.MODEL_CHANGE, Priority.EVALUATION)


@dataclass(frozen=True, slots=True)
class QueueDepth:
    """Jobs that a worker could claim and none has; jobs that wait for a vocabulary don't count."""

    jobs_by_map: Mapping[str, int]
    """Map name -> number of its jobs, without queries."""
    queries: int
    """Number of query photos and comparisons of all maps."""
    finished_per_second: float
    """Uploads and queries that succeeded or failed in the last THROUGHPUT_WINDOW_SECONDS."""

    @property
    def jobs(self) -> int:
        return sum(self.jobs_by_map.values())


def measure_queue_depth(session: Session, limit: int) -> QueueDepth:
    """Count up to `limit` jobs and up to `limit` queries, with the index that claims use."""
    jobs_by_map = _count_by_map(session, BACKLOG_PRIORITIES, limit)
    queries = sum(_count_by_map(session, (Priority.QUERY,), limit).values())
    finished = (
        select(Job.id)
        .where(
            Job.kind.in_((JobKind.INDEX, *QUERY_JOBS)),
            Job.finished_at > db_now_plus(-THROUGHPUT_WINDOW_SECONDS),
        )
        .limit(MAX_COUNTED_FINISHED)
        .subquery()
    )
    finished_count = session.scalar(select(func.count()).select_from(finished)) or 0
    return QueueDepth(jobs_by_map, queries, finished_count / THROUGHPUT_WINDOW_SECONDS)


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
