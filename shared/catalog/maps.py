"""Maps (named databases of photos), their search history and their statistics.

A deleted map keeps its row, under a name that requests can't use, until the steward has purged
everything that belongs to it. Searches are stored for SEARCH_HISTORY_DAYS.

The statistics of a map with up to MAX_EXACT_COUNT photos, jobs and searches are counted for each
request. Those of larger maps would take seconds: the steward caches them from time to time, and
the response has the time of the count.
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
    false,
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
DELETED_NAME_PREFIX = "deleted/"  # valid names of maps have no slash


class Map(Journaled, Base):
    """A map. Every transaction that changes its search results increments `version`."""

    __tablename__ = "maps"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    extractor: Mapped[str] = mapped_column(String(200))
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    place_labels_are_paths: Mapped[bool] = mapped_column(
        Boolean, default=False, server_default=false()
    )
    """Whether `/` separates the levels of the place labels."""
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    deleted_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


def create_map(
    session: Session, name: str, extractor: str, *, place_labels_are_paths: bool = False
) -> Map:
    """Create an empty map; Conflict (`map_exists`) when the name is taken."""
    map_ = Map(
        id=new_id(),
        name=name,
        extractor=extractor,
        place_labels_are_paths=place_labels_are_paths,
    )
    try:
        with session.begin_nested():
            session.add(map_)
            session.flush()
    except IntegrityError:
        raise Conflict("map_exists", f"A map named {name!r} already exists.", map=name) from None
    return map_


def list_maps(session: Session) -> list[Map]:
    """List the live maps by name."""
    return list(session.scalars(select(Map).where(Map.deleted_at.is_(None)).order_by(Map.name)))


def mark_map_deleted(session: Session, map_: Map) -> None:
    """Hide the map from all responses from this commit on, and free its name.

    `services.steward.tasks.delete_maps` deletes its data later.
    """
    map_.name = f"{DELETED_NAME_PREFIX}{map_.id}"
    map_.deleted_at = db_now()
    session.flush()


def get_or_create_default_map(session: Session, extractor: str) -> Map:
    """Return the map named `default`, created on first use."""
    existing = session.scalar(select(Map).where(Map.name == DEFAULT_MAP))
    if existing is not None:
        return existing
    try:
        return create_map(session, DEFAULT_MAP, extractor)
    except Conflict:  # another process created it between the two statements
        return get_map(session, DEFAULT_MAP)


def get_map(session: Session, name: str) -> Map:
    """Return the live map of this name; NotFound (`map_not_found`)."""
    map_ = session.scalar(select(Map).where(Map.name == name, Map.deleted_at.is_(None)))
    if map_ is None:
        raise NotFound(
            "map_not_found",
            f"There is no map named {name!r}. Create it: POST /api/v1/maps, or "
            f"`placewise maps create {name}`.",
            map=name,
        )
    return map_


def lock_map(session: Session, map_id: UUID) -> Map:
    """Lock the map's row until the end of the transaction, and return it refreshed.

    Publishing, activation and deletion take this lock, so the state of the map that they read stays
    valid until they commit. SQLite has one writer and needs no row lock.
    """
    return session.scalars(
        select(Map)
        .where(Map.id == map_id)
        .with_for_update()
        .execution_options(populate_existing=True)
    ).one()


def increment_map_version(session: Session, map_id: UUID) -> int:
    """Increment the map's version, so that search workers reload changes; return the new one.

    The row stays locked until the commit, so versions become visible in the order of their numbers.
    """
    return session.execute(
        update(Map).where(Map.id == map_id).values(version=Map.version + 1).returning(Map.version)
    ).scalar_one()


class Search(Base):
    """A completed similarity search, for the history and the statistics."""

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
    """List the map's searches, newest first, up to `limit`; `before` is the page's cursor."""
    statement = select(Search).where(Search.map_id == map_id)
    if before is not None:
        statement = statement.where(Search.id < before)
    return list(session.scalars(statement.order_by(Search.id.desc()).limit(limit)))


MIN_STATISTICS_AGE_SECONDS = 30.0
# Counting a large map takes at most 1/50 of the time: the pause is at least 50 times the duration.
RECOUNT_REST_FACTOR = 50.0
DAY_SECONDS = 86_400.0


class CachedMapStatistics(Base):
    """The last count of a large map: `MapStatistics` as JSON, and the duration of the count."""

    __tablename__ = "map_figures"

    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"), primary_key=True)
    figures: Mapped[dict[str, Any]] = mapped_column(JsonValue)
    counted_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    took_seconds: Mapped[float] = mapped_column(Float)


@dataclass(frozen=True, slots=True)
class MapStatistics:
    """Statistics of a map: counts of live rows; descriptors are those of the active generation."""

    photos: int
    labelled_queries: int
    photo_bytes: int
    uploads_24h: int
    searchable: int
    located: int
    """Searchable photos with coordinates or a place label."""
    located_queries: int
    """Labelled queries with coordinates or a place label."""
    searches: int
    searches_24h: int
    average_ms: float | None
    """Mean duration of the searches of the last seven days, in milliseconds."""
    longest_ms: float | None
    """Longest duration of the searches of the last seven days, in milliseconds."""
    jobs: dict[str, int]
    """State -> number of jobs."""


def get_map_statistics(session: Session, map_id: UUID) -> tuple[MapStatistics, datetime]:
    """Return the map's statistics and the time of the count; those of a large map are cached."""
    if is_large_map(session, map_id):
        cached = session.get(CachedMapStatistics, map_id)
        if cached is not None:
            return MapStatistics(**cached.figures), cached.counted_at
    return compute_map_statistics(session, map_id), session.execute(select(db_now())).scalar_one()


def is_large_map(session: Session, map_id: UUID) -> bool:
    """Return whether the map has more than MAX_EXACT_COUNT photos, jobs or searches."""
    row_selects: tuple[Select[Any], ...] = (
        select(literal(1)).select_from(Photo).where(Photo.map_id == map_id),
        select(literal(1)).select_from(Job).where(Job.map_id == map_id),
        select(literal(1)).select_from(Search).where(Search.map_id == map_id),
    )
    limit = MAX_EXACT_COUNT + 1
    return any(
        session.scalar(select(func.count()).select_from(rows.limit(limit).subquery())) == limit
        for rows in row_selects
    )


def compute_map_statistics(session: Session, map_id: UUID) -> MapStatistics:
    """Count the map's rows; this takes seconds on a map with a million photos."""
    generation = active_generation(session, map_id)
    live = (Photo.map_id == map_id) & Photo.deleted_at.is_(None)
    day_ago = db_now_plus(-DAY_SECONDS)
    searches = select(func.count()).select_from(Search).where(Search.map_id == map_id)
    average, longest = session.execute(
        select(func.avg(Search.processing_ms), func.max(Search.processing_ms)).where(
            Search.map_id == map_id, Search.searched_at > db_now_plus(-7 * DAY_SECONDS)
        )
    ).one()
    jobs = select(Job.state, func.count()).where(Job.map_id == map_id).group_by(Job.state)
    recent = select(func.count()).select_from(Photo).where(live, Photo.uploaded_at > day_ago)
    geotagged = (
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
        located=geotagged[0],
        located_queries=geotagged[1],
        searches=session.scalar(searches) or 0,
        searches_24h=session.scalar(searches.where(Search.searched_at > day_ago)) or 0,
        average_ms=average,
        longest_ms=longest,
        jobs={str(state): count for state, count in session.execute(jobs)},
    )


def are_statistics_stale(session: Session, map_id: UUID) -> bool:
    """Return whether the cached statistics of a large map are due to be counted again."""
    cached = session.get(CachedMapStatistics, map_id)
    if cached is None:
        return True
    max_age = max(MIN_STATISTICS_AGE_SECONDS, RECOUNT_REST_FACTOR * cached.took_seconds)
    is_stale = literal(cached.counted_at, UtcDateTime()) < db_now_plus(-max_age)
    return bool(session.scalar(select(is_stale)))


def cache_map_statistics(session: Session, map_id: UUID) -> None:
    """Count the map's rows and cache the statistics."""
    started = time.perf_counter()
    now = session.execute(select(db_now())).scalar_one()
    figures = asdict(compute_map_statistics(session, map_id))
    took = time.perf_counter() - started
    session.merge(
        CachedMapStatistics(map_id=map_id, figures=figures, counted_at=now, took_seconds=took)
    )
