"""`/vocabularies` and `/generations`: what a map's descriptors are made with, and changing it."""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import ADMIT_JOB, AdmissionDep, UploadKind
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import (
    DEFAULT_MAP,
    NO_NUL_PATTERN,
    GatewayContext,
    GatewayDep,
    MapName,
)
from services.gateway.idempotency import IdempotentDep, IdempotentFormDep, IdempotentRequest
from services.gateway.multipart_upload import multipart_schema, store_form_file
from services.gateway.schemas import (
    GenerationResponse,
    JobAcceptedResponse,
    VocabularyResponse,
    accept_job,
)
from shared.catalog.chunks import estimate_described
from shared.catalog.generations import list_generations
from shared.catalog.maps import get_map
from shared.catalog.models import check_model_registered
from shared.catalog.photos import PhotoRole, has_live_photo
from shared.catalog.vocabularies import get_pca_source_generation, get_vocabulary, list_vocabularies
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured, PlacewiseError, invalid_field_error
from shared.extractor_config.configs import MAX_CLUSTERS, MAX_PCA_DIMENSION, ExtractorConfig
from shared.jobs import Job, JobKind
from shared.jobs.model_changes import start_model_change
from shared.storage.keys import new_vocabulary_key
from shared.storage.vocabulary_npz import encode_vocabulary_file

router = APIRouter(tags=["model changes"])


class FitVocabularyRequest(BaseModel):
    """How to learn the vocabulary; {} is a good choice."""

    model_config = ConfigDict(extra="forbid")

    clusters: int | None = Field(
        None,
        ge=1,
        le=MAX_CLUSTERS,
        description="null: as many as the extractor's name says (64 unless it says otherwise); "
        "fewer are made when the photos bear fewer",
    )
    sample: int = Field(1000, ge=1, le=1_000_000, description="photos to learn from, at most")
    seed: int = Field(0, ge=0, le=2**31 - 1)


class StartGenerationRequest(BaseModel):
    """What the new generation is made with."""

    model_config = ConfigDict(extra="forbid")

    extractor: str | None = Field(
        None,
        max_length=200,
        pattern=NO_NUL_PATTERN,
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
        le=MAX_PCA_DIMENSION,
        description="bring the map's descriptors to so many dimensions; their vocabulary stays. "
        "null: whole descriptors",
    )


@router.post(
    "/vocabularies",
    operation_id="fit_vocabulary",
    status_code=202,
    response_model=JobAcceptedResponse,
    dependencies=[WRITE, ADMIT_JOB],
)
def start_vocabulary_fit(
    gateway: GatewayDep,
    response: Response,
    idempotent: IdempotentDep,
    options: FitVocabularyRequest | None = None,
    map_name: MapName = DEFAULT_MAP,
) -> JobAcceptedResponse:
    """Learn a vocabulary from the map's own photos and switch to it.

    All photos are described again in the background while search goes on; the job has succeeded
    when the new generation answers.
    """
    params = (options or FitVocabularyRequest.model_validate({})).model_dump()
    with gateway.catalog.write() as session:
        map_id = get_map(session, map_name).id
        if not has_live_photo(session, map_id, PhotoRole.DATABASE):
            raise Conflict("no_photos", "The map has no photos to learn from. Upload some first.")
        job = start_model_change(session, map_id, JobKind.FIT, params)
        idempotent.store_job_response(session, job)
    return _model_change_response(gateway, response, job, map_name)


@router.post(
    "/vocabularies/import",
    operation_id="import_vocabulary",
    status_code=202,
    response_model=JobAcceptedResponse,
    openapi_extra=multipart_schema(
        "a `.npz` file of `placewise vocabulary fit DIR`, or a `.npy` file of "
        "(clusters, dimension) floats"
    ),
    dependencies=[WRITE, ADMIT_JOB],
)
async def start_vocabulary_import(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    idempotent: IdempotentFormDep,
    admission: AdmissionDep,
    map_name: MapName = DEFAULT_MAP,
) -> JobAcceptedResponse:
    """Bring a vocabulary, a `.npz` or `.npy` file, and switch to it.

    The extractor checks it; one that does not fit, or that a `.npz` says was learnt from other
    features than the extractor makes, ends the job as `failed` with the reason.
    """
    with admission.admit_upload(UploadKind.UPLOAD, request):
        received = await store_form_file(
            request,
            gateway.store,
            new_vocabulary_key(),
            gateway.settings.max_vocabulary_bytes,
        )
    await idempotent.claim_form(gateway.store, received)
    params = {"object_key": received.key, "filename": received.filename}
    job = await run_in_threadpool(_queue_import, gateway, map_name, params, idempotent)
    return _model_change_response(gateway, response, job, map_name)


@router.get(
    "/vocabularies",
    operation_id="list_vocabularies",
    response_model=list[VocabularyResponse],
    dependencies=[READ],
)
def read_vocabularies(
    gateway: GatewayDep, map_name: MapName = DEFAULT_MAP
) -> list[VocabularyResponse]:
    """The map's vocabularies, newest first, with their provenance."""
    with gateway.catalog.read() as session:
        found = list_vocabularies(session, get_map(session, map_name).id)
    return [VocabularyResponse.of(vocabulary) for vocabulary in found]


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
def read_vocabulary_file(
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
    response_model=list[GenerationResponse],
    dependencies=[READ],
)
def read_generations(
    gateway: GatewayDep, map_name: MapName = DEFAULT_MAP
) -> list[GenerationResponse]:
    """The map's generations, newest first."""
    with gateway.catalog.read() as session:
        return [
            GenerationResponse.of(generation, estimate_described(session, generation.id))
            for generation in list_generations(session, get_map(session, map_name).id)
        ]


@router.post(
    "/generations",
    operation_id="start_generation",
    status_code=202,
    response_model=JobAcceptedResponse,
    dependencies=[WRITE, ADMIT_JOB],
)
def start_generation(
    gateway: GatewayDep,
    response: Response,
    idempotent: IdempotentDep,
    body: Annotated[StartGenerationRequest, Field()],
    map_name: MapName = DEFAULT_MAP,
) -> JobAcceptedResponse:
    """Describe all photos anew with a vocabulary that the map has or with another extractor, and
    switch to it; or shorten their descriptors by PCA whitening, fitted on those that the map has,
    and switch to these.
    """
    recipe = _validate_new_extractor(gateway.settings, body)
    with gateway.catalog.write() as session:
        map_id = get_map(session, map_name).id
        if body.pca is not None:
            job = _queue_pca(session, map_id, body.pca, body.vocabulary_id)
        else:
            job = _queue_switch(session, map_id, recipe, body.vocabulary_id)
        idempotent.store_job_response(session, job)
    return _model_change_response(gateway, response, job, map_name)


def _validate_new_extractor(
    settings: Settings, body: StartGenerationRequest
) -> ExtractorConfig | None:
    """The extractor that is asked for; 422 for one that can't be had, or not with the rest."""
    if body.extractor is None:
        return None
    if body.pca is not None:
        raise invalid_field_error(
            "pca", "is fitted on descriptors that are there: switch to the extractor first"
        )
    try:
        recipe = settings.recipe(body.extractor)
    except Misconfigured as error:
        raise invalid_field_error("extractor", error.detail) from None
    if recipe.needs_vocabulary:
        if body.vocabulary_id is None and recipe.shipped_vocabulary is None:
            raise invalid_field_error(
                "vocabulary_id",
                f"no vocabulary comes with {recipe.name}: name one that the map has "
                "(GET /api/v1/vocabularies), or fit one in a map of its own",
            )
    elif body.vocabulary_id is not None:
        raise invalid_field_error("vocabulary_id", f"{recipe.name} uses none: leave it out")
    return recipe


def _queue_switch(
    session: Session, map_id: UUID, recipe: ExtractorConfig | None, vocabulary_id: UUID | None
) -> Job:
    params: dict[str, Any] = {"vocabulary_id": str(vocabulary_id) if vocabulary_id else None}
    if vocabulary_id is not None:
        get_vocabulary(session, map_id, vocabulary_id)
    if recipe is not None:
        check_model_registered(session, recipe)
        params["extractor"] = recipe.name
    return start_model_change(session, map_id, JobKind.SWITCH, params)


def _queue_pca(session: Session, map_id: UUID, pca: int, vocabulary_id: UUID | None) -> Job:
    source = get_pca_source_generation(session, map_id)
    if vocabulary_id is not None and vocabulary_id != source.vocabulary_id:
        raise invalid_field_error(
            "vocabulary_id",
            "PCA is fitted on the descriptors that answer: leave it out, or switch"
            " to that vocabulary first",
        )
    if pca > source.dimension:
        raise invalid_field_error(
            "pca", f"the map's descriptors have {source.dimension} dimensions"
        )
    return start_model_change(session, map_id, JobKind.PCA, {"pca": pca})


def _queue_import(
    gateway: GatewayContext, map_name: str, params: dict[str, Any], idempotent: IdempotentRequest
) -> Job:
    try:
        with gateway.catalog.write() as session:
            map_id = get_map(session, map_name).id
            job = start_model_change(session, map_id, JobKind.IMPORT, params)
            idempotent.store_job_response(session, job)
            return job
    except PlacewiseError:
        gateway.store.delete(params["object_key"])
        raise


def _model_change_response(
    gateway: GatewayContext, response: Response, job: Job, map_name: str
) -> JobAcceptedResponse:
    gateway.hints.send()
    return accept_job(response, job, map_name)
