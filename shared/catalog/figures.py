"""How much a map holds, and how much was asked of it.

A map of up to COUNTED_NOW photos, jobs and searches is counted whenever someone asks. Counting
more would cost every caller seconds: the steward counts larger ones from time to time, and the
answer says when it did.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import Float, ForeignKey, Select, Uuid, func, literal, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now, db_now_plus
from shared.catalog.chunks import MAX_EXACT_COUNT, count_geotagged, count_searchable
from shared.catalog.generations import active_generation
from shared.catalog.photos import Photo, PhotoRole, count_live_photos
from shared.catalog.searches import Search
from shared.jobs.table import Job

MIN_STATISTICS_AGE_SECONDS = 30.0
# A large map's figures are counted in 1/50 of the time at most.
RECOUNT_REST_FACTOR = 50.0
DAY_SECONDS = 86_400.0


class CachedMapStatistics(Base):
    """The last count of a large map: `MapStatistics` as JSON, and how long it took."""

    __tablename__ = "map_figures"

    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"), primary_key=True)
    figures: Mapped[dict[str, Any]] = mapped_column(JsonValue)
    counted_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    took_seconds: Mapped[float] = mapped_column(Float)


@dataclass(frozen=True, slots=True)
class MapStatistics:
    """Counts of live rows; those of descriptors are of the generation that answers."""

    photos: int
    labelled_queries: int
    photo_bytes: int
    uploads_24h: int
    searchable: int
    located: int
    """Searchable ones whose place is known."""
    located_queries: int
    searches: int
    searches_24h: int
    average_ms: float | None
    """Of the searches of the last seven days, as is `longest_ms`."""
    longest_ms: float | None
    jobs: dict[str, int]
    """By state."""


def get_map_statistics(session: Session, map_id: UUID) -> tuple[MapStatistics, datetime]:
    """The map's figures, and the time for which they hold."""
    if is_large_map(session, map_id):
        kept = session.get(CachedMapStatistics, map_id)
        if kept is not None:
            return MapStatistics(**kept.figures), kept.counted_at
    return compute_map_statistics(session, map_id), session.execute(select(db_now())).scalar_one()


def is_large_map(session: Session, map_id: UUID) -> bool:
    """Whether the map has too much to be counted for every caller."""
    of_map: tuple[Select[Any], ...] = (
        select(literal(1)).select_from(Photo).where(Photo.map_id == map_id),
        select(literal(1)).select_from(Job).where(Job.map_id == map_id),
        select(literal(1)).select_from(Search).where(Search.map_id == map_id),
    )
    most = MAX_EXACT_COUNT + 1
    return any(
        session.scalar(select(func.count()).select_from(rows.limit(most).subquery())) == most
        for rows in of_map
    )


def compute_map_statistics(session: Session, map_id: UUID) -> MapStatistics:
    """Count everything; on a map with a million photos this takes seconds."""
    generation = active_generation(session, map_id)
    live = (Photo.map_id == map_id) & Photo.deleted_at.is_(None)
    day = db_now_plus(-DAY_SECONDS)
    asked = select(func.count()).select_from(Search).where(Search.map_id == map_id)
    average, longest = session.execute(
        select(func.avg(Search.processing_ms), func.max(Search.processing_ms)).where(
            Search.map_id == map_id, Search.searched_at > db_now_plus(-7 * DAY_SECONDS)
        )
    ).one()
    jobs = select(Job.state, func.count()).where(Job.map_id == map_id).group_by(Job.state)
    recent = select(func.count()).select_from(Photo).where(live, Photo.uploaded_at > day)
    located = (
        [count_geotagged(session, generation.id, role) for role in PhotoRole]
        if generation
        else [0, 0]
    )
    return MapStatistics(
        photos=count_live_photos(session, map_id, PhotoRole.DATABASE),
        labelled_queries=count_live_photos(session, map_id, PhotoRole.QUERY),
        photo_bytes=int(session.scalar(select(func.sum(Photo.size_bytes)).where(live)) or 0),
        uploads_24h=session.scalar(recent) or 0,
        searchable=count_searchable(session, generation.id) if generation else 0,
        located=located[0],
        located_queries=located[1],
        searches=session.scalar(asked) or 0,
        searches_24h=session.scalar(asked.where(Search.searched_at > day)) or 0,
        average_ms=average,
        longest_ms=longest,
        jobs={str(state): count for state, count in session.execute(jobs)},
    )


def are_statistics_stale(session: Session, map_id: UUID) -> bool:
    """Whether a large map's figures have become old."""
    kept = session.get(CachedMapStatistics, map_id)
    if kept is None:
        return True
    age = max(MIN_STATISTICS_AGE_SECONDS, RECOUNT_REST_FACTOR * kept.took_seconds)
    return bool(session.scalar(select(literal(kept.counted_at, UtcDateTime()) < db_now_plus(-age))))


def cache_map_statistics(session: Session, map_id: UUID) -> None:
    """Count, and keep the figures."""
    started = time.perf_counter()
    now = session.execute(select(db_now())).scalar_one()
    figures = asdict(compute_map_statistics(session, map_id))
    took = time.perf_counter() - started
    session.merge(
        CachedMapStatistics(map_id=map_id, figures=figures, counted_at=now, took_seconds=took)
    )
