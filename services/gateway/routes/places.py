"""Routes that propose places for photos of a map that have none, give them, and undo that."""

from __future__ import annotations

from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Query
from pydantic import Field
from sqlalchemy import select

from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import GatewayDep, MapPageParams, MapQuery
from services.gateway.given_places import (
    GivenPlaceBody,
    give_places,
    propose_places,
    undo_places,
)
from services.gateway.routes.positions import ProposalOptions
from shared.catalog.database.base import count_rows, list_newest
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo, is_geotagged
from shared.enums import PhotoRole
from shared.http.request_model import FailFastList, RequestModel
from shared.responses.reconstructions import (
    GivenPlacesResponse,
    PlaceProposalsResponse,
    UndonePlacesResponse,
)

router = APIRouter(tags=["photos"])

PROPOSALS_PATH = "/places/proposals"
MAX_GIVEN = 1000


class ProposalsParams(MapPageParams):
    limit: int = Field(20, ge=1, le=50, description="each photo of a page is searched with")


class GivenPlacesBody(RequestModel):
    photos: FailFastList[GivenPlaceBody] = Field(min_length=1, max_length=MAX_GIVEN)


class UndoPlacesBody(RequestModel):
    file_ids: list[UUID] | None = Field(
        None, max_length=MAX_GIVEN, description="omitted: all photos whose place was given"
    )


@router.post(PROPOSALS_PATH, operation_id="propose_places", dependencies=[READ])
def propose_page(
    gateway: GatewayDep, query: Annotated[ProposalsParams, Query()], options: ProposalOptions
) -> PlaceProposalsResponse:
    """Propose places for the photos of a map that have neither coordinates nor a label.

    Each proposal combines what a search with the photo finds, photos of the same camera that were
    taken shortly before or after, and a GPX track. Test photos are left out. Nothing is stored.
    """
    with gateway.catalog.read() as session:
        without = (
            Photo.map_id == get_map(session, query.map).id,
            Photo.deleted_at.is_(None),
            Photo.role == PhotoRole.DATABASE,
            ~is_geotagged(),
        )
        total = count_rows(session, select(Photo.id).where(*without))
        photos = list_newest(session, Photo, *without, limit=query.limit + 1, before=query.before)
    page, next_cursor = query.split(photos)
    return PlaceProposalsResponse(
        total=total,
        proposals=propose_places(gateway, query.map, page, options),
        next_cursor=next_cursor,
    )


@router.post("/places", operation_id="give_places", dependencies=[WRITE])
def give(gateway: GatewayDep, query: MapQuery, body: GivenPlacesBody) -> GivenPlacesResponse:
    """Give places to photos that have none, such as accepted proposals.

    A photo that has coordinates or a label is skipped. What a photo had before is kept: `POST
    /places/undo` restores it.
    """
    return gateway.catalog.run(
        lambda session: give_places(session, get_map(session, query.map).id, body.photos)
    )


@router.post("/places/undo", operation_id="undo_places", dependencies=[WRITE])
def undo(gateway: GatewayDep, query: MapQuery, body: UndoPlacesBody) -> UndonePlacesResponse:
    """Take back given places: photos have the values that they had before.

    A photo whose place was changed since is left as it is, and named.
    """
    return gateway.catalog.run(
        lambda session: undo_places(session, get_map(session, query.map).id, body.file_ids)
    )
