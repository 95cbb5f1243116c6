"""`/vocabularies` and `/generations`: what a map's descriptors are made with, and changing it."""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.context import DEFAULT_MAP, NO_NUL, Gateway, GatewayDep, MapName
from services.gateway.key_check import READ, WRITE
from services.gateway.once import Once, OnceDep, OnceFormDep
from services.gateway.receive import describe_form, receive_file
from services.gateway.room import ROOM_FOR_JOBS, Kind, RoomDep
from services.gateway.schemas import (
    GenerationAnswer,
    JobStarted,
    VocabularyAnswer,
    started_job,
)
from shared.catalog.added_models import check_model
from shared.catalog.chunks import about_described
from shared.catalog.generations import list_generations
from shared.catalog.maps import get_map
from shared.catalog.photos import PhotoRole, has_live
from shared.catalog.vocabularies import get_vocabulary, list_vocabularies
from shared.catalog.whitenings import generation_to_whiten
from shared.errors import Conflict, Misconfigured, PlacewiseError, invalid_field
from shared.jobs import Job, JobKind
from shared.jobs.model_changes import start_model_change
from shared.objects.keys import new_vocabulary_key
from shared.recipes import MOST_CLUSTERS, MOST_PCA, Recipe
from shared.settings import Settings
from shared.vocabulary_npz import encode_vocabulary_file

router = APIRouter(tags=["model changes"])


class FitRequest(BaseModel):
    """How to learn the vocabulary; {} is a good choice."""

    model_config = ConfigDict(extra="forbid")

    clusters: int | None = Field(
        None,
        ge=1,
        le=MOST_CLUSTERS,
        description="null: as many as the extractor's name says (64 unless it says otherwise); "
        "fewer are made when the photos bear fewer",
    )
    sample: int = Field(1000, ge=1, le=1_000_000, description="photos to learn from, at most")
    seed: int = Field(0, ge=0, le=2**31 - 1)


class SwitchRequest(BaseModel):
    """What the new generation is made with."""

    model_config = ConfigDict(extra="forbid")

    extractor: str | None = Field(
        None,
        max_length=200,
        pattern=NO_NUL,
        description="another extractor, such as gsv:NAME of a model that was added; null: the "
        "map's own",
    )
    vocabulary_id: UUID | None = Field(
        None,
        description="null for extractors without one, with `pca`, and for the one that comes with "
        "another `extractor`",
    )
    pca: int | None = Field(
        None,
        ge=1,
        le=MOST_PCA,
        description="bring the map's descriptors to so many dimensions; their vocabulary stays. "
        "null: whole descriptors",
    )


@router.post(
    "/vocabularies",
    operation_id="fit_vocabulary",
    status_code=202,
    response_model=JobStarted,
    dependencies=[WRITE, ROOM_FOR_JOBS],
)
def fit_vocabulary(
    gateway: GatewayDep,
    response: Response,
    once: OnceDep,
    wanted: FitRequest | None = None,
    map_name: MapName = DEFAULT_MAP,
) -> JobStarted:
    """Learn a vocabulary from the map's own photos and switch to it.

    All photos are described again in the background while search goes on; the job has succeeded
    when the new generation answers.
    """
    params = (wanted or FitRequest.model_validate({})).model_dump()
    with gateway.catalog.write() as session:
        map_id = get_map(session, map_name).id
        if not has_live(session, map_id, PhotoRole.DATABASE):
            raise Conflict("no_photos", "The map has no photos to learn from. Upload some first.")
        job = start_model_change(session, map_id, JobKind.FIT, params)
        once.keep_job(session, job)
    return _started(gateway, response, job, map_name)


@router.post(
    "/vocabularies/import",
    operation_id="import_vocabulary",
    status_code=202,
    response_model=JobStarted,
    openapi_extra=describe_form(
        "a `.npz` file of `placewise vocabulary fit DIR`, or a `.npy` file of "
        "(clusters, dimension) floats"
    ),
    dependencies=[WRITE, ROOM_FOR_JOBS],
)
async def import_vocabulary(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    once: OnceFormDep,
    room: RoomDep,
    map_name: MapName = DEFAULT_MAP,
) -> JobStarted:
    """Bring a vocabulary, a `.npz` or `.npy` file, and switch to it.

    The extractor checks it; one that does not fit, or that a `.npz` says was learnt from other
    features than the extractor makes, ends the job as `failed` with the reason.
    """
    with room.receiving(Kind.UPLOAD, request):
        received = await receive_file(
            request,
            gateway.store,
            new_vocabulary_key(),
            gateway.settings.max_vocabulary_bytes,
        )
    await once.begin_form(gateway.store, received)
    params = {"object_key": received.key, "filename": received.filename}
    job = await run_in_threadpool(_queue_import, gateway, map_name, params, once)
    return _started(gateway, response, job, map_name)


@router.get(
    "/vocabularies",
    operation_id="list_vocabularies",
    response_model=list[VocabularyAnswer],
    dependencies=[READ],
)
def vocabularies(gateway: GatewayDep, map_name: MapName = DEFAULT_MAP) -> list[VocabularyAnswer]:
    """The map's vocabularies, newest first, with their provenance."""
    with gateway.catalog.read() as session:
        found = list_vocabularies(session, get_map(session, map_name).id)
    return [VocabularyAnswer.of(vocabulary) for vocabulary in found]


@router.get(
    "/vocabularies/{vocabulary_id}/file",
    operation_id="get_vocabulary_file",
    response_class=Response,
    responses={
        200: {
            "content": {
                "application/zip": {"schema": {"type": "string", "format": "binary"}},
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
            }
        }
    },
    dependencies=[READ],
)
def vocabulary_file(
    gateway: GatewayDep,
    vocabulary_id: UUID,
    map_name: MapName = DEFAULT_MAP,
) -> Response:
    """The vocabulary as the file that `POST /vocabularies/import` takes elsewhere: `.npz` with its
    provenance, or `.npy` (`application/octet-stream`) where that is unknown.
    """
    with gateway.catalog.read() as session:
        found = get_vocabulary(session, get_map(session, map_name).id, vocabulary_id)
    data, suffix = encode_vocabulary_file(
        gateway.store.get(found.object_key), found.sha256, found.provenance
    )
    return Response(
        data,
        media_type="application/zip" if suffix == ".npz" else "application/octet-stream",
        headers={"Content-Disposition": f'attachment; filename="{found.id}{suffix}"'},
    )


@router.get(
    "/generations",
    operation_id="list_generations",
    response_model=list[GenerationAnswer],
    dependencies=[READ],
)
def generations(gateway: GatewayDep, map_name: MapName = DEFAULT_MAP) -> list[GenerationAnswer]:
    """The map's generations, newest first."""
    with gateway.catalog.read() as session:
        return [
            GenerationAnswer.of(generation, about_described(session, generation.id))
            for generation in list_generations(session, get_map(session, map_name).id)
        ]


@router.post(
    "/generations",
    operation_id="start_generation",
    status_code=202,
    response_model=JobStarted,
    dependencies=[WRITE, ROOM_FOR_JOBS],
)
def start_generation(
    gateway: GatewayDep,
    response: Response,
    once: OnceDep,
    wanted: Annotated[SwitchRequest, Field()],
    map_name: MapName = DEFAULT_MAP,
) -> JobStarted:
    """Describe all photos anew with a vocabulary that the map has or with another extractor, and
    switch to it; or shorten their descriptors by PCA whitening, fitted on those that the map has,
    and switch to these.
    """
    recipe = _other_extractor(gateway.settings, wanted)
    with gateway.catalog.write() as session:
        map_id = get_map(session, map_name).id
        if wanted.pca is not None:
            job = _queue_pca(session, map_id, wanted.pca, wanted.vocabulary_id)
        else:
            job = _queue_switch(session, map_id, recipe, wanted.vocabulary_id)
        once.keep_job(session, job)
    return _started(gateway, response, job, map_name)


def _other_extractor(settings: Settings, wanted: SwitchRequest) -> Recipe | None:
    """The extractor that is asked for; 422 for one that can't be had, or not with the rest."""
    if wanted.extractor is None:
        return None
    if wanted.pca is not None:
        raise invalid_field(
            "pca", "is fitted on descriptors that are there: switch to the extractor first"
        )
    try:
        recipe = settings.recipe(wanted.extractor)
    except Misconfigured as error:
        raise invalid_field("extractor", error.detail) from None
    if recipe.needs_vocabulary:
        if wanted.vocabulary_id is None and recipe.shipped_vocabulary is None:
            raise invalid_field(
                "vocabulary_id",
                f"no vocabulary comes with {recipe.name}: name one that the map has "
                "(GET /api/v1/vocabularies), or fit one in a map of its own",
            )
    elif wanted.vocabulary_id is not None:
        raise invalid_field("vocabulary_id", f"{recipe.name} uses none: leave it out")
    return recipe


def _queue_switch(
    session: Session, map_id: UUID, recipe: Recipe | None, vocabulary_id: UUID | None
) -> Job:
    params: dict[str, Any] = {"vocabulary_id": str(vocabulary_id) if vocabulary_id else None}
    if vocabulary_id is not None:
        get_vocabulary(session, map_id, vocabulary_id)
    if recipe is not None:
        check_model(session, recipe)
        params["extractor"] = recipe.name
    return start_model_change(session, map_id, JobKind.SWITCH, params)


def _queue_pca(session: Session, map_id: UUID, pca: int, vocabulary_id: UUID | None) -> Job:
    source = generation_to_whiten(session, map_id)
    if vocabulary_id is not None and vocabulary_id != source.vocabulary_id:
        raise invalid_field(
            "vocabulary_id",
            "PCA is fitted on the descriptors that answer: leave it out, or switch"
            " to that vocabulary first",
        )
    if pca > source.dimension:
        raise invalid_field("pca", f"the map's descriptors have {source.dimension} dimensions")
    return start_model_change(session, map_id, JobKind.PCA, {"pca": pca})


def _queue_import(gateway: Gateway, map_name: str, params: dict[str, Any], once: Once) -> Job:
    try:
        with gateway.catalog.write() as session:
            map_id = get_map(session, map_name).id
            job = start_model_change(session, map_id, JobKind.IMPORT, params)
            once.keep_job(session, job)
            return job
    except PlacewiseError:
        gateway.store.delete(params["object_key"])
        raise


def _started(gateway: Gateway, response: Response, job: Job, map_name: str) -> JobStarted:
    gateway.hints.send()
    return started_job(response, job, map_name)
