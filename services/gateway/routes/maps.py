"""Routes of maps: named photo databases, each with its own extractor and active generation."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Depends, Path, Request
from pydantic import Field, field_validator
from sqlalchemy.orm import Session

from services.gateway.authentication import READ, WRITE, get_caller
from services.gateway.dependencies import ALL_MAPS, NO_NUL_PATTERN, NO_PARAMETERS, GatewayDep
from services.gateway.idempotency import IdempotentDep
from services.gateway.schemas import RequestModel, ResponseModel
from shared.catalog.generations import RowType, active_generation
from shared.catalog.maps import (
    DEFAULT_MAP,
    MAP_NAME_PATTERN,
    Map,
    create_map,
    get_map,
    get_map_statistics,
    get_or_create_default_map,
    list_maps,
    lock_map,
    mark_map_deleted,
)
from shared.catalog.models import check_model_registered
from shared.catalog.vocabularies import vocabulary_standing
from shared.errors import Misconfigured, invalid_field_error
from shared.jobs import Job
from shared.jobs.transitions import cancel_jobs

router = APIRouter(tags=["maps"], dependencies=[NO_PARAMETERS])

MapNamePath = Annotated[
    str, Path(description="the map's name", min_length=1, max_length=100, pattern=NO_NUL_PATTERN)
]


async def _check_map(request: Request, name: MapNamePath) -> None:
    get_caller(request).check_map(name)


CHECK_MAP = Depends(_check_map)


class CreateMapRequest(RequestModel):
    name: str = Field(json_schema_extra={"pattern": MAP_NAME_PATTERN})
    extractor: str | None = Field(
        None,
        max_length=200,
        pattern=NO_NUL_PATTERN,
        description="omitted: the default of the server",
    )
    place_labels_are_paths: bool = Field(
        False,
        description="whether `/` separates the levels of place labels, as in "
        "`tower/floor 7/elevator`",
    )
    rows: RowType | None = Field(
        None,
        description="type of the stored descriptors: float16, or float32 in twice the space; "
        "omitted: the default of the server",
    )

    @field_validator("name")
    @classmethod
    def _validate_name(cls, name: str) -> str:
        if not re.fullmatch(MAP_NAME_PATTERN, name):
            raise ValueError(
                "a map name must have 1 to 100 letters, digits, `.`, `_` and `-`, and begin with a "
                "letter or digit"
            )
        return name


class UpdateMapRequest(RequestModel):
    place_labels_are_paths: bool | None = Field(None, description="omitted: unchanged")
    rows: RowType | None = Field(
        None,
        description="type of the stored descriptors of generations that are created from now on; "
        "omitted: unchanged",
    )


class MapResponse(ResponseModel):
    name: str
    extractor: str
    version: int = Field(description="incremented by every change of the searchable photos")
    photos: int
    searchable: int
    labelled_queries: int
    counted_at: datetime = Field(description="when the three counts above were computed")
    generation_id: UUID | None
    vocabulary: str | None = Field(
        description="`own`, `provisional`, `foreign`, `pending` or `none`; null before the first "
        "photo"
    )
    dimension: int | None = Field(
        description="dimension of its descriptors; null before the first photo"
    )
    pca_from: int | None = Field(description="dimension before PCA; null without PCA")
    place_labels_are_paths: bool = Field(
        description="whether `/` separates the levels of place labels"
    )
    rows: RowType = Field(
        description="type of the stored descriptors, `float32` or `float16`, of new generations; "
        "GET /generations has the one of each generation"
    )
    created_at: datetime


class DeletedMapResponse(ResponseModel):
    success: bool
    message: str
    deleted_map: str


@router.get("/maps", operation_id="list_maps", dependencies=[READ])
def read_maps(request: Request, gateway: GatewayDep) -> list[MapResponse]:
    """List the maps that the caller may use, by name."""
    allowed = get_caller(request).maps
    with gateway.catalog.read() as session:
        return [
            _map_response(session, map_)
            for map_ in list_maps(session)
            if allowed is None or map_.name in allowed
        ]


@router.post("/maps", operation_id="create_map", status_code=201, dependencies=[WRITE, ALL_MAPS])
def create_new_map(
    gateway: GatewayDep, body: CreateMapRequest, idempotent: IdempotentDep
) -> MapResponse:
    """Create an empty map; 409 if the name exists already."""
    settings = gateway.settings
    try:
        config = settings.extractor_config(body.extractor or settings.new_map_extractor)
    except Misconfigured as error:
        raise invalid_field_error("extractor", error.detail) from None
    with gateway.catalog.write() as session:
        check_model_registered(session, config)
        map_ = create_map(
            session,
            body.name,
            config.name,
            place_labels_are_paths=body.place_labels_are_paths,
            row_type=body.rows or RowType(settings.descriptor_rows),
        )
        response = _map_response(session, map_)
        idempotent.store_response(session, 201, response)
    return response


@router.get("/maps/{name}", operation_id="get_map", dependencies=[READ, CHECK_MAP])
def read_map(gateway: GatewayDep, name: MapNamePath) -> MapResponse:
    """Get one map."""
    with gateway.catalog.read() as session:
        return _map_response(session, get_map(session, name))


@router.patch("/maps/{name}", operation_id="update_map", dependencies=[WRITE, CHECK_MAP])
def update_map(gateway: GatewayDep, name: MapNamePath, body: UpdateMapRequest) -> MapResponse:
    """Change whether the map's place labels are paths, and the type of its stored descriptors.

    After a change of the labels, the probabilities of its estimates are those of the prior until
    the next evaluation. A change of `rows` applies to generations that are created from now on:
    POST /generations creates one.
    """

    def update(session: Session) -> MapResponse:
        map_ = lock_map(session, get_map(session, name).id)
        if body.place_labels_are_paths is not None:
            map_.place_labels_are_paths = body.place_labels_are_paths
        if body.rows is not None:
            map_.row_type = body.rows
        session.flush()
        return _map_response(session, map_)

    return gateway.catalog.run(update)


@router.delete("/maps/{name}", operation_id="delete_map", dependencies=[WRITE, CHECK_MAP])
def delete_map(gateway: GatewayDep, name: MapNamePath) -> DeletedMapResponse:
    """Delete a map with all its photos. An empty map `default` is created again.

    Searches do not return its photos any more; their bytes are deleted in the background.
    """

    def remove(session: Session) -> None:
        map_ = lock_map(session, get_map(session, name).id)
        cancel_jobs(session, Job.map_id == map_.id)
        mark_map_deleted(session, map_)
        if name == DEFAULT_MAP:
            settings = gateway.settings
            get_or_create_default_map(
                session, settings.new_map_extractor, RowType(settings.descriptor_rows)
            )

    gateway.catalog.run(remove)
    return DeletedMapResponse(success=True, message=f"The map {name} is deleted.", deleted_map=name)


def _map_response(session: Session, map_: Map) -> MapResponse:
    generation = active_generation(session, map_.id)
    statistics, counted_at = get_map_statistics(session, map_.id)
    return MapResponse(
        name=map_.name,
        extractor=map_.extractor,
        version=map_.version,
        photos=statistics.photos,
        searchable=statistics.searchable,
        labelled_queries=statistics.labelled_queries,
        counted_at=counted_at,
        generation_id=generation.id if generation else None,
        vocabulary=vocabulary_standing(session, generation) if generation else None,
        dimension=generation.dimension if generation else None,
        pca_from=generation.pca_from if generation else None,
        place_labels_are_paths=map_.place_labels_are_paths,
        rows=RowType(map_.row_type),
        created_at=map_.created_at,
    )
