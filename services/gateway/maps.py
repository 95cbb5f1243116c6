"""`/maps`: named databases of photos, each with its own extractor, vocabulary and generation."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Path
from pydantic import BaseModel, ConfigDict, Field, field_validator
from sqlalchemy.orm import Session

from services.gateway.context import DEFAULT_MAP, NO_NUL, GatewayDep
from services.gateway.key_check import READ, WRITE
from services.gateway.once import OnceDep
from services.gateway.schemas import Answer
from shared.catalog.added_models import check_model
from shared.catalog.figures import figures_of
from shared.catalog.generations import active_generation
from shared.catalog.maps import (
    MAP_NAME,
    Map,
    create_map,
    ensure_default_map,
    get_map,
    list_maps,
    lock_map,
    mark_map_deleted,
)
from shared.catalog.vocabularies import standing_of
from shared.errors import Misconfigured, invalid_field
from shared.jobs import Job
from shared.jobs.finish import cancel_all

router = APIRouter(tags=["maps"])

MapPath = Annotated[
    str, Path(description="the map's name", min_length=1, max_length=100, pattern=NO_NUL)
]


class NewMap(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str = Field(json_schema_extra={"pattern": MAP_NAME})
    extractor: str | None = Field(
        None, max_length=200, pattern=NO_NUL, description="left out: the configured one"
    )

    @field_validator("name")
    @classmethod
    def _can_stand_in_an_address(cls, name: str) -> str:
        if not re.fullmatch(MAP_NAME, name):
            raise ValueError(
                "a map's name has up to 100 letters, digits, `.`, `_` and `-`, and begins with a "
                "letter or digit"
            )
        return name


class MapAnswer(Answer):
    name: str
    extractor: str
    version: int = Field(description="grows with every change of what can be found")
    photos: int
    searchable: int
    labelled_queries: int
    counted_at: datetime = Field(description="when the three counts above were made")
    generation_id: UUID | None
    vocabulary: str | None = Field(description="own, foreign, none; null before the first photo")
    dimension: int | None = Field(description="of its descriptors; null before the first photo")
    pca_from: int | None = Field(description="their dimension before PCA; null without")
    created_at: datetime


class MapDeleted(Answer):
    success: bool
    message: str
    deleted_map: str


@router.get("/maps", operation_id="list_maps", response_model=list[MapAnswer], dependencies=[READ])
def maps(gateway: GatewayDep) -> list[MapAnswer]:
    """Every map, by name."""
    with gateway.catalog.read() as session:
        return [_answer(session, map_) for map_ in list_maps(session)]


@router.post(
    "/maps",
    operation_id="create_map",
    status_code=201,
    response_model=MapAnswer,
    dependencies=[WRITE],
)
def new_map(gateway: GatewayDep, wanted: NewMap, once: OnceDep) -> MapAnswer:
    """Make an empty map; 409 when the name is taken."""
    settings = gateway.settings
    try:
        recipe = settings.recipe(wanted.extractor or settings.new_map_extractor)
    except Misconfigured as error:
        raise invalid_field("extractor", error.detail) from None
    with gateway.catalog.write() as session:
        check_model(session, recipe)
        answer = _answer(session, create_map(session, wanted.name, recipe.name))
        once.keep(session, 201, answer)
    return answer


@router.get("/maps/{name}", operation_id="get_map", response_model=MapAnswer, dependencies=[READ])
def one_map(gateway: GatewayDep, name: MapPath) -> MapAnswer:
    """One map."""
    with gateway.catalog.read() as session:
        return _answer(session, get_map(session, name))


@router.delete(
    "/maps/{name}", operation_id="delete_map", response_model=MapDeleted, dependencies=[WRITE]
)
def delete_map(gateway: GatewayDep, name: MapPath) -> MapDeleted:
    """Gone with all its photos at once; its bytes follow. `default` is made anew, empty."""

    def remove(session: Session) -> None:
        map_ = lock_map(session, get_map(session, name).id)
        cancel_all(session, Job.map_id == map_.id)
        mark_map_deleted(session, map_)
        if name == DEFAULT_MAP:
            ensure_default_map(session, gateway.settings.new_map_extractor)

    gateway.catalog.run(remove)
    return MapDeleted(success=True, message=f"The map {name} is deleted.", deleted_map=name)


def _answer(session: Session, map_: Map) -> MapAnswer:
    generation = active_generation(session, map_.id)
    figures, counted_at = figures_of(session, map_.id)
    return MapAnswer(
        name=map_.name,
        extractor=map_.extractor,
        version=map_.version,
        photos=figures.photos,
        searchable=figures.searchable,
        labelled_queries=figures.labelled_queries,
        counted_at=counted_at,
        generation_id=generation.id if generation else None,
        vocabulary=standing_of(session, generation) if generation else None,
        dimension=generation.dimension if generation else None,
        pca_from=generation.pca_from if generation else None,
        created_at=map_.created_at,
    )
