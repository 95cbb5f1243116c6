"""`/database/stats`: how much there is, and how much was asked."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from services.gateway.context import DEFAULT_MAP, GatewayDep, MapName
from services.gateway.schemas import Answer
from shared.catalog.base import Condition, db_now_plus
from shared.catalog.chunks import Chunk, count_searchable
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo, PhotoRole, count_live
from shared.catalog.searches import Search
from shared.catalog.vocabularies import standing_of
from shared.jobs import Job

router = APIRouter(tags=["operations"])

DAY_SECONDS = 86_400


class StatsAnswer(Answer):
    map: str
    map_version: int
    total_images: int
    searchable_images: int
    labelled_queries: int
    total_chunks: int
    total_storage_bytes: int
    feature_dimension: int | None
    max_images_per_chunk: int
    extractor: str
    vocabulary: str | None
    total_searches: int
    recent_uploads_24h: int
    recent_searches_24h: int
    avg_processing_time_ms: float | None
    max_processing_time_ms: float | None
    jobs: dict[str, int]


@router.get("/database/stats", operation_id="database_stats", response_model=StatsAnswer)
def stats(gateway: GatewayDep, map_name: MapName = DEFAULT_MAP) -> StatsAnswer:
    """Figures of one map; search times are those of the last seven days."""
    with gateway.catalog.read() as session:
        map_ = get_map(session, map_name)
        generation = active_generation(session, map_.id)
        live = (Photo.map_id == map_.id) & Photo.deleted_at.is_(None)
        in_map = Search.map_id == map_.id
        chunks, chunk_bytes = 0, 0
        vocabulary = None
        if generation is not None:
            now = (Chunk.generation_id == generation.id) & Chunk.superseded_at.is_(None)
            chunks = _number(session, func.count(Chunk.id), now)
            chunk_bytes = _number(session, func.sum(Chunk.size_bytes), now)
            vocabulary = standing_of(session, generation)
        week = in_map & (Search.searched_at > db_now_plus(-7 * DAY_SECONDS))
        average, longest = session.execute(
            select(func.avg(Search.processing_ms), func.max(Search.processing_ms)).where(week)
        ).one()
        by_state = session.execute(
            select(Job.state, func.count()).where(Job.map_id == map_.id).group_by(Job.state)
        )
        return StatsAnswer(
            map=map_.name,
            map_version=map_.version,
            total_images=count_live(session, map_.id, PhotoRole.DATABASE),
            labelled_queries=count_live(session, map_.id, PhotoRole.QUERY),
            searchable_images=count_searchable(session, generation.id) if generation else 0,
            total_chunks=chunks,
            total_storage_bytes=chunk_bytes + _number(session, func.sum(Photo.size_bytes), live),
            feature_dimension=generation.dimension if generation else None,
            max_images_per_chunk=gateway.settings.slot_rows,
            extractor=generation.extractor if generation else map_.extractor,
            vocabulary=vocabulary,
            total_searches=_number(session, func.count(Search.id), in_map),
            recent_uploads_24h=_number(
                session,
                func.count(Photo.id),
                live & (Photo.uploaded_at > db_now_plus(-DAY_SECONDS)),
            ),
            recent_searches_24h=_number(
                session,
                func.count(Search.id),
                in_map & (Search.searched_at > db_now_plus(-DAY_SECONDS)),
            ),
            avg_processing_time_ms=average,
            max_processing_time_ms=longest,
            jobs={str(state): count for state, count in by_state},
        )


def _number(session: Session, what: Any, condition: Condition) -> int:
    return int(session.scalar(select(what).where(condition)) or 0)
