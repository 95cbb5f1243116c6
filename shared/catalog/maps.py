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

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.chunks import (
    MAX_EXACT_COUNT,
    count_geotagged,
    count_searchable,
    select_failed_photos,
)
from shared.catalog.database.base import (
    Base,
    Entity,
    Journaled,
    JsonValue,
    UtcDateTime,
    count_rows,
    db_now,
    db_now_plus,
    for_update,
    get_or_insert,
    insert_row,
)
from shared.catalog.generations import Generation, GenerationState, RowType, active_generation
from shared.catalog.jobs import Job
from shared.catalog.photos import (
    Photo,
    PhotoRole,
    count_live_photos,
    is_geotagged,
    select_live_photos,
)
from shared.enums import Matching as Matching
from shared.errors import Conflict, NotFound
from shared.place_paths import look_like_paths

DEFAULT_MAP = "default"
MAP_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
DELETED_NAME_PREFIX = "deleted/"  # valid names of maps have no slash


class Map(Journaled, Entity):
    """A map. Every transaction that changes its search results increments `version`."""

    __tablename__ = "maps"

    name: Mapped[str] = mapped_column(sa.String(100), unique=True)
    extractor: Mapped[str] = mapped_column(sa.String(200))
    version: Mapped[int] = mapped_column(sa.BigInteger, default=0)
    place_labels_are_paths: Mapped[bool] = mapped_column(
        sa.Boolean, default=False, server_default=sa.false()
    )
    """Whether `/` separates the levels of the place labels."""
    place_labels_are_automatic: Mapped[bool] = mapped_column(
        sa.Boolean, default=True, server_default=sa.true()
    )
    """Whether `decide_label_paths` decides that by the labels."""
    row_type: Mapped[RowType] = mapped_column(
        sa.String(20), default=RowType.FLOAT32, server_default=RowType.FLOAT32
    )
    """Type of the descriptor rows of its new generations."""
    auto_fit: Mapped[bool] = mapped_column(sa.Boolean, default=True, server_default=sa.true())
    """Whether the steward fits vocabularies for it."""
    fitted_photos: Mapped[int | None] = mapped_column(sa.Integer)
    """Number of its database photos when the last fit of its extractor's vocabulary was started."""
    matching: Mapped[Matching] = mapped_column(
        sa.String(20), default=Matching.AUTO, server_default=Matching.AUTO
    )
    elsewhere: Mapped[float | None] = mapped_column(sa.Float)
    """Share of its queries that are from elsewhere; null: ELSEWHERE_SHARE."""
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    deleted_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


def create_map(
    session: Session,
    name: str,
    extractor: str,
    *,
    place_labels_are_paths: bool | None = None,
    row_type: RowType = RowType.FLOAT32,
    auto_fit: bool = True,
    matching: Matching = Matching.AUTO,
    elsewhere: float | None = None,
) -> Map:
    """Create an empty map; Conflict (`map_exists`) when the name is taken.

    With None, its labels decide whether they are paths.
    """
    map_ = Map(
        name=name,
        extractor=extractor,
        place_labels_are_paths=bool(place_labels_are_paths),
        place_labels_are_automatic=place_labels_are_paths is None,
        row_type=row_type,
        auto_fit=auto_fit,
        matching=matching,
        elsewhere=elsewhere,
    )
    try:
        with session.begin_nested():
            return insert_row(session, map_)
    except IntegrityError:
        raise Conflict("map_exists", f"A map named {name!r} already exists.", map=name) from None


def list_maps(session: Session) -> list[Map]:
    """List the live maps by name."""
    return list(session.scalars(sa.select(Map).where(Map.deleted_at.is_(None)).order_by(Map.name)))


def list_extractors_in_use(session: Session) -> set[str]:
    """Return the names of the extractors of all maps and of their active generations."""
    of_generations = sa.select(Generation.extractor).join(Map, Map.id == Generation.map_id)
    return {
        *session.scalars(sa.select(Map.extractor).where(Map.deleted_at.is_(None))),
        *session.scalars(
            of_generations.where(
                Generation.state == GenerationState.ACTIVE, Map.deleted_at.is_(None)
            )
        ),
    }


def count_failed_photos(session: Session) -> dict[str, int]:
    """Return the names of the maps with photos whose description failed, and their number."""
    counts = {
        map_.name: count_rows(session, select_failed_photos(map_.id)) for map_ in list_maps(session)
    }
    return {name: count for name, count in counts.items() if count}


def mark_map_deleted(session: Session, map_: Map) -> None:
    """Hide the map from all responses from this commit on, and free its name.

    `services.steward.tasks.delete_maps` deletes its data later.
    """
    map_.name = f"{DELETED_NAME_PREFIX}{map_.id}"
    map_.deleted_at = db_now()
    session.flush()


def get_or_create_default_map(
    session: Session, extractor: str, row_type: str = RowType.FLOAT32
) -> Map:
    """Return the map named `default`, created on first use."""
    named_default = sa.select(Map).where(Map.name == DEFAULT_MAP)
    new = Map(name=DEFAULT_MAP, extractor=extractor, row_type=RowType(row_type))
    return get_or_insert(session, named_default, new)


def get_map(session: Session, name: str) -> Map:
    """Return the live map of this name; NotFound (`map_not_found`)."""
    map_ = session.scalar(sa.select(Map).where(Map.name == name, Map.deleted_at.is_(None)))
    if map_ is None:
        raise map_not_found_error(name)
    return map_


def map_not_found_error(name: str) -> NotFound:
    """The error of a call about a map that does not exist."""
    return NotFound(
        "map_not_found",
        f"There is no map named {name!r}. Create it: POST /api/v1/maps, or "
        f"`placewise maps create {name}`.",
        map=name,
    )


def lock_map(session: Session, map_id: UUID) -> Map:
    """Lock the map's row until the end of the transaction, and return it refreshed.

    Publishing, activation and deletion take this lock, so the state of the map that they read stays
    valid until they commit. SQLite has one writer and needs no row lock.
    """
    return session.scalars(for_update(sa.select(Map).where(Map.id == map_id))).one()


def increment_map_version(session: Session, map_id: UUID) -> int:
    """Increment the map's version, so that search workers reload changes; return the new one.

    The row stays locked until the commit, so versions become visible in the order of their numbers.
    """
    return session.execute(
        sa.update(Map)
        .where(Map.id == map_id)
        .values(version=Map.version + 1)
        .returning(Map.version)
    ).scalar_one()


def decide_label_paths(session: Session, map_: Map) -> bool:
    """Return whether the map's labels are paths: by their look, if that is automatic.

    They are if they look like paths (`look_like_paths`) and most photos with a place have a label
    and no coordinates: the levels of coordinates are circles.
    """
    if not map_.place_labels_are_automatic:
        return map_.place_labels_are_paths
    is_labelled = Photo.latitude.is_(None)
    photos = sa.select(is_labelled, Photo.place, sa.func.count()).where(
        Photo.map_id == map_.id,
        Photo.deleted_at.is_(None),
        Photo.role == PhotoRole.DATABASE,
        is_geotagged(),
    )
    counts = session.execute(photos.group_by(is_labelled, Photo.place)).all()
    labels = {str(place): count for labelled, place, count in counts if labelled}
    located = sum(count for _, _, count in counts)
    return 2 * sum(labels.values()) > located and look_like_paths(labels)


class Search(Entity):
    """A completed similarity search, for the history and the statistics."""

    __tablename__ = "searches"

    map_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("maps.id"))
    generation_id: Mapped[UUID] = mapped_column(sa.Uuid)
    query_photo_id: Mapped[UUID | None] = mapped_column(sa.Uuid)
    query_filename: Mapped[str] = mapped_column(sa.Text)
    top_k: Mapped[int] = mapped_column(sa.Integer)
    results: Mapped[int] = mapped_column(sa.Integer)
    processing_ms: Mapped[float] = mapped_column(sa.Float)
    best_score: Mapped[float | None] = mapped_column(sa.Float)
    in_map: Mapped[bool | None] = mapped_column(sa.Boolean)
    answer_level: Mapped[int | None] = mapped_column(sa.Integer)
    not_in_map_probability: Mapped[float | None] = mapped_column(sa.Float)
    """null if the estimate had no levels"""
    has_place: Mapped[bool] = mapped_column(sa.Boolean, default=False, server_default=sa.false())
    """Whether the estimate named a place."""
    searched_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    __table_args__ = (
        sa.Index("ix_searches_map_time", "map_id", "searched_at"),
        sa.Index("ix_searches_map_id", "map_id", "id"),
        sa.Index("ix_searches_time", "searched_at"),
    )


RECENT_SEARCHES = 100


def recent_best_scores(session: Session, map_id: UUID, generation_id: UUID) -> list[float]:
    """Return the best scores of those of the last RECENT_SEARCHES that searched a generation."""
    recent = (
        sa.select(Search.best_score, Search.generation_id)
        .where(Search.map_id == map_id)
        .order_by(Search.id.desc())
        .limit(RECENT_SEARCHES)
    )
    return [
        score
        for score, generation in session.execute(recent)
        if score is not None and generation == generation_id
    ]


MIN_STATISTICS_AGE_SECONDS = 30.0
# Counting a large map takes at most 1/50 of the time: the pause is at least 50 times the duration.
RECOUNT_REST_FACTOR = 50.0
DAY_SECONDS = 86_400.0


class CachedMapStatistics(Base):
    """The last count of a large map: `MapStatistics` as JSON, and the duration of the count."""

    __tablename__ = "map_figures"

    map_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("maps.id"), primary_key=True)
    figures: Mapped[dict[str, Any]] = mapped_column(JsonValue)
    counted_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    took_seconds: Mapped[float] = mapped_column(sa.Float)


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
    failed_photos: int = 0
    """Photos that can't be searched for, because their description failed."""


def get_map_statistics(session: Session, map_id: UUID) -> tuple[MapStatistics, datetime]:
    """Return the map's statistics and the time of the count; those of a large map are cached."""
    if is_large_map(session, map_id):
        cached = session.get(CachedMapStatistics, map_id)
        if cached is not None:
            return MapStatistics(**cached.figures), cached.counted_at
    return _compute_map_statistics(session, map_id), session.execute(
        sa.select(db_now())
    ).scalar_one()


def is_large_map(session: Session, map_id: UUID) -> bool:
    """Return whether the map has more than MAX_EXACT_COUNT photos, jobs or searches."""
    limit = MAX_EXACT_COUNT + 1
    return any(
        count_rows(session, sa.select(table.id).where(table.map_id == map_id), limit) == limit
        for table in (Photo, Job, Search)
    )


def _compute_map_statistics(session: Session, map_id: UUID) -> MapStatistics:
    """Count the map's rows; this takes seconds on a map with a million photos."""
    generation = active_generation(session, map_id)
    live = (Photo.map_id == map_id) & Photo.deleted_at.is_(None)
    day_ago = db_now_plus(-DAY_SECONDS)
    searches = sa.select(Search.id).where(Search.map_id == map_id)
    average, longest = session.execute(
        sa.select(sa.func.avg(Search.processing_ms), sa.func.max(Search.processing_ms)).where(
            Search.map_id == map_id, Search.searched_at > db_now_plus(-7 * DAY_SECONDS)
        )
    ).one()
    jobs = sa.select(Job.state, sa.func.count()).where(Job.map_id == map_id).group_by(Job.state)
    geotagged = (
        [count_geotagged(session, generation.id, role) for role in PhotoRole]
        if generation
        else [0, 0]
    )
    return MapStatistics(
        photos=count_live_photos(session, map_id, PhotoRole.DATABASE),
        labelled_queries=count_live_photos(session, map_id, PhotoRole.QUERY),
        photo_bytes=int(session.scalar(sa.select(sa.func.sum(Photo.size_bytes)).where(live)) or 0),
        uploads_24h=count_rows(
            session, sa.select(Photo.id).where(live, Photo.uploaded_at > day_ago)
        ),
        searchable=count_searchable(session, generation.id) if generation else 0,
        located=geotagged[0],
        located_queries=geotagged[1],
        searches=count_rows(session, searches),
        searches_24h=count_rows(session, searches.where(Search.searched_at > day_ago)),
        average_ms=average,
        longest_ms=longest,
        jobs={str(state): count for state, count in session.execute(jobs)},
        failed_photos=count_rows(session, select_failed_photos(map_id)),
    )


def has_database_photos(session: Session, map_id: UUID, number: int) -> bool:
    """Return whether the map has `number` live photos that are no labelled queries.

    Above MAX_EXACT_COUNT the cached statistics answer.
    """
    if number > MAX_EXACT_COUNT:
        cached = session.get(CachedMapStatistics, map_id)
        return cached is not None and MapStatistics(**cached.figures).photos >= number
    photos = select_live_photos(map_id, PhotoRole.DATABASE)
    return count_rows(session, photos, number) == number


def are_statistics_stale(session: Session, map_id: UUID) -> bool:
    """Return whether the cached statistics of a large map are due to be counted again."""
    cached = session.get(CachedMapStatistics, map_id)
    if cached is None:
        return True
    max_age = max(MIN_STATISTICS_AGE_SECONDS, RECOUNT_REST_FACTOR * cached.took_seconds)
    is_stale = sa.literal(cached.counted_at, UtcDateTime()) < db_now_plus(-max_age)
    return bool(session.scalar(sa.select(is_stale)))


def cache_map_statistics(session: Session, map_id: UUID) -> None:
    """Count the map's rows and cache the statistics."""
    started = time.perf_counter()
    now = session.execute(sa.select(db_now())).scalar_one()
    figures = asdict(_compute_map_statistics(session, map_id))
    took = time.perf_counter() - started
    session.merge(
        CachedMapStatistics(map_id=map_id, figures=figures, counted_at=now, took_seconds=took)
    )
