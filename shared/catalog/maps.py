"""Maps: named databases of photos, each with its own extractor, active generation and version.

A deleted map keeps its row, under a name that no one can ask for, until the steward has removed
everything that belongs to it.

Searches: what was asked, for the history and the figures; kept for SEARCH_HISTORY_DAYS.

How much a map holds, and how much was asked of it.

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

from sqlalchemy import (
    BigInteger,
    Boolean,
    Float,
    ForeignKey,
    Index,
    Integer,
    Select,
    String,
    Text,
    Uuid,
    func,
    literal,
    select,
    update,
)
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, Journaled, JsonValue, UtcDateTime, db_now, db_now_plus
from shared.catalog.chunks import MAX_EXACT_COUNT, count_geotagged, count_searchable
from shared.catalog.generations import active_generation
from shared.catalog.jobs import Job
from shared.catalog.photos import Photo, PhotoRole, count_live_photos
from shared.errors import Conflict, NotFound
from shared.ids import new_id

DEFAULT_MAP = "default"
MAP_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
DELETED_NAME_PREFIX = "deleted/"  # no name that people can give holds a slash


class Map(Journaled, Base):
    """`version` grows with every transaction that changes what can be found in the map."""

    __tablename__ = "maps"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    extractor: Mapped[str] = mapped_column(String(200))
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    deleted_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


def create_map(session: Session, name: str, extractor: str) -> Map:
    """A new, empty map; 409 (`map_exists`) when the name is taken."""
    made = Map(id=new_id(), name=name, extractor=extractor)
    try:
        with session.begin_nested():
            session.add(made)
            session.flush()
    except IntegrityError:
        raise Conflict("map_exists", f"There is a map named {name!r} already.", map=name) from None
    return made


def list_maps(session: Session) -> list[Map]:
    """Every live map, by name."""
    return list(session.scalars(select(Map).where(Map.deleted_at.is_(None)).order_by(Map.name)))


def mark_map_deleted(session: Session, map_: Map) -> None:
    """The map is gone from every answer from this commit on, and its name is free.

    What belongs to it goes later: `services.steward.tasks.delete_maps`.
    """
    map_.name = f"{DELETED_NAME_PREFIX}{map_.id}"
    map_.deleted_at = db_now()
    session.flush()


def get_or_create_default_map(session: Session, extractor: str) -> Map:
    """The map named `default`, made on first use."""
    found = session.scalar(select(Map).where(Map.name == DEFAULT_MAP))
    if found is not None:
        return found
    try:
        return create_map(session, DEFAULT_MAP, extractor)
    except Conflict:  # another process made it between the two statements
        return get_map(session, DEFAULT_MAP)


def get_map(session: Session, name: str) -> Map:
    """The map called `name`; 404 when there is none."""
    found = session.scalar(select(Map).where(Map.name == name, Map.deleted_at.is_(None)))
    if found is None:
        raise NotFound(
            "map_not_found",
            f"There is no map named {name!r}. Make it: POST /api/v1/maps, or "
            f"`placewise maps create {name}`.",
            map=name,
        )
    return found


def lock_map(session: Session, map_id: UUID) -> Map:
    """The map's row as it is now, locked until the transaction ends.

    Publishing, activation and deletion take this lock, so what they read of the map stays true
    until they commit. SQLite has one writer and needs no row lock.
    """
    return session.scalars(
        select(Map)
        .where(Map.id == map_id)
        .with_for_update()
        .execution_options(populate_existing=True)
    ).one()


def increment_map_version(session: Session, map_id: UUID) -> int:
    """One more: search workers following the map will look again. Returns the new version.

    The row stays locked until commit, so versions become visible in the order of their numbers.
    """
    return session.execute(
        update(Map).where(Map.id == map_id).values(version=Map.version + 1).returning(Map.version)
    ).scalar_one()


class Search(Base):
    """One answered similarity search."""

    __tablename__ = "searches"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"))
    generation_id: Mapped[UUID] = mapped_column(Uuid)
    query_photo_id: Mapped[UUID | None] = mapped_column(Uuid)
    query_filename: Mapped[str] = mapped_column(Text)
    top_k: Mapped[int] = mapped_column(Integer)
    results: Mapped[int] = mapped_column(Integer)
    processing_ms: Mapped[float] = mapped_column(Float)
    best_score: Mapped[float | None] = mapped_column(Float)
    in_map: Mapped[bool | None] = mapped_column(Boolean)
    searched_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    __table_args__ = (
        Index("ix_searches_map_time", "map_id", "searched_at"),
        Index("ix_searches_map_id", "map_id", "id"),
        Index("ix_searches_time", "searched_at"),
    )


def list_searches(
    session: Session, map_id: UUID, limit: int, before: UUID | None = None
) -> list[Search]:
    """Newest first, up to `limit`, older than `before`."""
    wanted = select(Search).where(Search.map_id == map_id)
    if before is not None:
        wanted = wanted.where(Search.id < before)
    return list(session.scalars(wanted.order_by(Search.id.desc()).limit(limit)))


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
