"""`/searches`: what was asked of a map."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Query
from pydantic import Field

from services.gateway.context import DEFAULT_MAP, GatewayDep, MapName, parse_cursor
from services.gateway.key_check import READ
from services.gateway.schemas import ResponseModel
from shared.catalog.maps import get_map
from shared.catalog.searches import Search, list_searches

router = APIRouter(tags=["operations"])


class SearchHistoryEntry(ResponseModel):
    search_id: UUID
    query_file_id: UUID | None = Field(description="null when the query photo is not stored")
    query_filename: str
    generation_id: UUID
    top_k: int
    results: int
    best_score: float | None
    in_map: bool | None = Field(description="what the estimate said")
    processing_time_ms: float
    searched_at: datetime

    @classmethod
    def of(cls, search: Search) -> SearchHistoryEntry:
        return cls(
            search_id=search.id,
            query_file_id=search.query_photo_id,
            query_filename=search.query_filename,
            generation_id=search.generation_id,
            top_k=search.top_k,
            results=search.results,
            best_score=search.best_score,
            in_map=search.in_map,
            processing_time_ms=search.processing_ms,
            searched_at=search.searched_at,
        )


class SearchHistoryResponse(ResponseModel):
    searches: list[SearchHistoryEntry]
    next_cursor: str | None


@router.get(
    "/searches",
    operation_id="list_searches",
    response_model=SearchHistoryResponse,
    dependencies=[READ],
)
def read_searches(
    gateway: GatewayDep,
    limit: Annotated[int, Query(ge=1, le=1000)] = 50,
    cursor: Annotated[str | None, Query()] = None,
    map_name: MapName = DEFAULT_MAP,
) -> SearchHistoryResponse:
    """Similarity searches, newest first; kept for SEARCH_HISTORY_DAYS."""
    with gateway.catalog.read() as session:
        map_id = get_map(session, map_name).id
        found = list_searches(session, map_id, limit + 1, parse_cursor(cursor))
    page = found[:limit]
    return SearchHistoryResponse(
        searches=[SearchHistoryEntry.of(search) for search in page],
        next_cursor=str(page[-1].id) if len(found) > limit else None,
    )
