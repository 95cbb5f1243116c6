"""Routes of maps: named photo databases, each with its own extractor and active generation."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Path, Request
from pydantic import Field, field_validator
from sqlalchemy.orm import Session

from services.gateway.authentication import READ, WRITE, get_caller
from services.gateway.dependencies import ALL_MAPS, NO_NUL_PATTERN, NO_PARAMETERS, GatewayDep
from services.gateway.idempotency import IdempotentDep
from shared.catalog.chunks import count_features, find_features_model
from shared.catalog.generations import Generation, RowType, active_generation
from shared.catalog.jobs import UNFINISHED_STATES, list_jobs
from shared.catalog.maps import (
    DEFAULT_MAP,
    MAP_NAME_PATTERN,
    Map,
    Matching,
    create_map,
    decide_label_paths,
    get_map,
    get_map_statistics,
    get_or_create_default_map,
    list_maps,
    lock_map,
    mark_map_deleted,
)
from shared.catalog.models import check_model_registered
from shared.catalog.vocabularies import next_fit_photos, vocabulary_standing
from shared.config.settings import Settings
from shared.errors import Misconfigured, invalid_field_error
from shared.evaluation.places.fit import MIN_OWN_PHOTOS
from shared.evaluation.places.levels import LevelScheme
from shared.evaluation.places.probability import ELSEWHERE_SHARE, PlaceModel
from shared.http.request_model import RequestModel
from shared.jobs import Job, JobKind, JobState
from shared.jobs.model_changes import get_unfinished_model_change, start_reindex
from shared.jobs.transitions import cancel_jobs
from shared.responses.maps import (
    AUTO_FIT,
    ELSEWHERE,
    MATCHING,
    DeletedMapResponse,
    LocalFeaturesResponse,
    MapResponse,
    Measurement,
)

router = APIRouter(tags=["maps"], dependencies=[NO_PARAMETERS])

MapNamePath = Annotated[
    str, Path(description="the map's name", min_length=1, max_length=100, pattern=NO_NUL_PATTERN)
]


async def _check_map(request: Request, name: MapNamePath) -> None:
    get_caller(request).check_map(name)


CHECK_MAP = Depends(_check_map)


Share = Annotated[float, Field(gt=0, lt=1, description=ELSEWHERE)]


class CreateMapRequest(RequestModel):
    name: str = Field(json_schema_extra={"pattern": MAP_NAME_PATTERN})
    extractor: str | None = Field(
        None,
        max_length=200,
        pattern=NO_NUL_PATTERN,
        description="omitted: the default of the server",
    )
    place_labels_are_paths: bool | None = Field(
        None,
        description="whether `/` separates the levels of place labels, as in "
        "`tower/floor 7/elevator`; omitted: evaluations decide that by the labels",
    )
    rows: RowType | None = Field(
        None,
        description="type of the stored descriptors: float16, or float32 in twice the space; "
        "omitted: the default of the server",
    )
    auto_fit: bool = Field(True, description=AUTO_FIT)
    matching: Matching = Field(Matching.AUTO, description=MATCHING)
    elsewhere: Share | None = None

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
    place_labels_are_paths: bool | Literal["auto"] | None = Field(
        None,
        description="`auto`: by the labels, now and at each evaluation; omitted: unchanged",
    )
    rows: RowType | None = Field(
        None,
        description="type of the stored descriptors of generations that are created from now on; "
        "omitted: unchanged",
    )
    auto_fit: bool | None = Field(None, description=f"{AUTO_FIT}; omitted: unchanged")
    matching: Matching | None = Field(
        None,
        description=f"{MATCHING}. `on` starts a model change if photos have no local features yet; "
        "omitted: unchanged",
    )
    elsewhere: Share | None = None


@router.get("/maps", operation_id="list_maps", dependencies=[READ])
def read_maps(request: Request, gateway: GatewayDep) -> list[MapResponse]:
    """List the maps that the caller may use, by name."""
    allowed = get_caller(request).maps
    with gateway.catalog.read() as session:
        return [
            _map_response(session, gateway.settings, map_)
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
            auto_fit=body.auto_fit,
            matching=body.matching,
            elsewhere=body.elsewhere,
        )
        response = _map_response(session, settings, map_)
        idempotent.store_response(session, 201, response)
    return response


@router.get("/maps/{name}", operation_id="get_map", dependencies=[READ, CHECK_MAP])
def read_map(gateway: GatewayDep, name: MapNamePath) -> MapResponse:
    """Get one map."""
    with gateway.catalog.read() as session:
        return _map_response(session, gateway.settings, get_map(session, name))


@router.patch("/maps/{name}", dependencies=[WRITE, CHECK_MAP])
def update_map(gateway: GatewayDep, name: MapNamePath, body: UpdateMapRequest) -> MapResponse:
    """Change settings of the map: labels that are paths, stored descriptors, fits, matching, and
    how many queries are from elsewhere.

    After a change of the labels, its estimates have no levels until the next evaluation, which
    starts by itself if automatic evaluations are on. A change of `rows` applies to generations that
    are created from now on: POST /generations creates one.

    `matching: on` starts a model change (`model_change_id`) that computes missing local features
    and keeps the descriptors, while searches continue; 409 while another model change runs.
    """

    def update(session: Session) -> MapResponse:
        map_ = lock_map(session, get_map(session, name).id)
        if body.place_labels_are_paths == "auto":
            map_.place_labels_are_automatic = True
            map_.place_labels_are_paths = decide_label_paths(session, map_)
        elif body.place_labels_are_paths is not None:
            map_.place_labels_are_automatic = False
            map_.place_labels_are_paths = body.place_labels_are_paths
        if body.rows is not None:
            map_.row_type = body.rows
        if body.auto_fit is not None:
            map_.auto_fit = body.auto_fit
        if body.matching is not None:
            map_.matching = body.matching
        if body.elsewhere is not None:
            map_.elsewhere = body.elsewhere
        active = active_generation(session, map_.id)
        is_on = body.matching == Matching.ON
        if is_on and active and count_features(session, active.id).missing:
            start_reindex(session, active)
        session.flush()
        return _map_response(session, gateway.settings, map_)

    response = gateway.catalog.run(update)
    gateway.wakeups.send()
    return response


@router.delete("/maps/{name}", dependencies=[WRITE, CHECK_MAP])
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
            get_or_create_default_map(session, settings.new_map_extractor, settings.descriptor_rows)

    gateway.catalog.run(remove)
    return DeletedMapResponse(success=True, message=f"The map {name} is deleted.", deleted_map=name)


def _map_response(session: Session, settings: Settings, map_: Map) -> MapResponse:
    generation = active_generation(session, map_.id)
    change = get_unfinished_model_change(session, map_.id)
    statistics, counted_at = get_map_statistics(session, map_.id)
    return MapResponse.of_row(
        map_,
        elsewhere=map_.elsewhere or ELSEWHERE_SHARE,
        photos=statistics.photos,
        searchable=statistics.searchable,
        failed_photos=statistics.failed_photos,
        labelled_queries=statistics.labelled_queries,
        located=statistics.located,
        measurement=_measurement(session, settings, map_, generation, statistics.located),
        counted_at=counted_at,
        generation_id=generation.id if generation else None,
        vocabulary=vocabulary_standing(session, generation) if generation else None,
        dimension=generation.dimension if generation else None,
        pca_from=generation.pca_from if generation else None,
        local_features=_local_features(session, generation) if generation else None,
        model_change_id=change.id if change else None,
        next_fit_photos=next_fit_photos(session, map_),
    )


def _local_features(session: Session, generation: Generation) -> LocalFeaturesResponse:
    counts = count_features(session, generation.id)
    return LocalFeaturesResponse(
        model=find_features_model(session, generation.id),
        photos=counts.photos,
        missing=counts.missing,
        bytes=counts.size_bytes,
        used=generation.uses_matches,
    )


def _measurement(
    session: Session, settings: Settings, map_: Map, generation: Generation | None, located: int
) -> Measurement:
    """Return whether estimates have probabilities, or what it takes."""
    if generation is None:
        return "too_few_photos"
    stored = generation.calibration and PlaceModel.model_validate(generation.calibration)
    scheme = LevelScheme(
        labels_are_paths=map_.place_labels_are_paths, radii_m=settings.level_radii_m
    )
    if stored and stored.for_scheme(scheme).is_fitted:
        return "measured"
    newest = list_jobs(session, map_.id, (), (JobKind.EVALUATE,), 1, None)
    if any(job.state in UNFINISHED_STATES for job in newest):
        return "running"
    if located < MIN_OWN_PHOTOS:
        return "too_few_photos"
    has_failed = any(job.state != JobState.SUCCEEDED for job in newest)
    has_new_levels = bool(
        stored and stored.scheme and stored.scheme.labels_are_paths != scheme.labels_are_paths
    )
    is_due = (
        0 < settings.auto_evaluate_photos <= located
        and not has_failed
        and (generation.calibration is None or has_new_levels)
    )
    return "due" if is_due else "not_measured"
