"""Routes of the search history (`/searches`) and of a map's statistics (`/database/stats`)."""

from __future__ import annotations

from fastapi import APIRouter
from sqlalchemy import func, select

from services.gateway.authentication import READ
from services.gateway.dependencies import GatewayDep, MapQuery, PageQuery
from shared.catalog.chunks import Chunk
from shared.catalog.generations import active_generation
from shared.catalog.maps import Search, get_map, get_map_statistics
from shared.catalog.processes import list_processes
from shared.catalog.vocabularies import next_fit_photos, vocabulary_standing
from shared.responses import ResponseModel
from shared.responses.maps import SearchHistoryEntry, StatsResponse

router = APIRouter(tags=["operations"])


class SearchHistoryResponse(ResponseModel):
    searches: list[SearchHistoryEntry]
    next_cursor: str | None


@router.get("/searches", dependencies=[READ])
def list_searches(gateway: GatewayDep, query: PageQuery) -> SearchHistoryResponse:
    """List similarity searches, newest first. They are kept for SEARCH_HISTORY_DAYS."""
    with gateway.catalog.read() as session:
        is_of_map = Search.map_id == get_map(session, query.map).id
        page, next_cursor = query.read(session, Search, is_of_map)
    return SearchHistoryResponse(
        searches=[SearchHistoryEntry.model_validate(search) for search in page],
        next_cursor=next_cursor,
    )


@router.get("/database/stats", dependencies=[READ])
def database_stats(gateway: GatewayDep, query: MapQuery) -> StatsResponse:
    """Get statistics of a map. Search times cover the last seven days.

    For maps with more than 10,000 photos, jobs or searches, the statistics are cached; `counted_at`
    shows their age.
    """
    with gateway.catalog.read() as session:
        map_ = get_map(session, query.map)
        generation = active_generation(session, map_.id)
        statistics, counted_at = get_map_statistics(session, map_.id)
        chunks, chunk_bytes = 0, 0
        if generation is not None:
            chunks, chunk_bytes = session.execute(
                select(
                    func.count(),
                    func.coalesce(func.sum(Chunk.size_bytes + Chunk.features_bytes), 0),
                ).where(Chunk.generation_id == generation.id, Chunk.superseded_at.is_(None))
            ).one()
        return StatsResponse.of_row(
            statistics,
            map=map_.name,
            map_version=map_.version,
            total_chunks=chunks,
            total_storage_bytes=int(chunk_bytes) + statistics.photo_bytes,
            feature_dimension=generation.dimension if generation else None,
            max_images_per_chunk=gateway.settings.chunk_rows,
            extractor=generation.extractor if generation else map_.extractor,
            device=next(
                (
                    process.state["device"]
                    for process in list_processes(session)
                    if process.is_live and "device" in process.state
                ),
                None,
            ),
            vocabulary=vocabulary_standing(session, generation) if generation else None,
            next_fit_photos=next_fit_photos(session, map_),
            counted_at=counted_at,
        )
