"""Routes of vocabularies and generations, and of the jobs that change a map's model."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from fastapi import APIRouter, Request, Response
from pydantic import Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import ADMIT_JOB, AdmissionDep, UploadKind
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import NO_NUL_PATTERN, GatewayContext, GatewayDep, MapQuery
from services.gateway.idempotency import IdempotentDep, IdempotentFormDep, IdempotentRequest
from services.gateway.responses import JobAcceptedResponse
from services.gateway.uploads.multipart import FormFile, multipart_schema, receive_form_file
from shared.catalog.chunks import estimate_described
from shared.catalog.database.base import list_newest
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import get_map
from shared.catalog.models import check_model_registered
from shared.catalog.photos import PhotoRole, has_live_photo
from shared.catalog.vocabularies import Vocabulary, get_pca_source_generation, get_vocabulary
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured, invalid_field_error
from shared.extractor_config.configs import (
    DEFAULT_SAMPLE_PHOTOS,
    MAX_CLUSTERS,
    MAX_PCA_DIMENSION,
    ExtractorConfig,
)
from shared.http.request_model import RequestModel
from shared.jobs import Job, JobKind
from shared.jobs.model_changes import start_model_change
from shared.jobs.wakeups import JobMessage
from shared.responses.maps import GenerationResponse, VocabularyResponse
from shared.storage.keys import new_vocabulary_key
from shared.storage.vocabulary_npz import encode_vocabulary_file

router = APIRouter(tags=["model changes"])

MAX_VOCABULARY_BYTES = 64_000_000


class FitVocabularyRequest(RequestModel):
    """Options of the fit; the defaults suit most maps."""

    clusters: int | None = Field(
        None,
        ge=1,
        le=MAX_CLUSTERS,
        description="null: the number in the extractor's name, or 64; fewer are fitted if the "
        "photos have too few features",
    )
    sample: int = Field(
        DEFAULT_SAMPLE_PHOTOS, ge=1, le=1_000_000, description="maximum number of photos to fit on"
    )
    seed: int = Field(0, ge=0, le=2**31 - 1)


class StartGenerationRequest(RequestModel):
    """Extractor, vocabulary or PCA dimension of the new generation."""

    extractor: str | None = Field(
        None,
        max_length=200,
        pattern=NO_NUL_PATTERN,
        description="another extractor, such as gsv:NAME for an added model; null: the map's "
        "extractor",
    )
    vocabulary_id: UUID | None = Field(
        None,
        description="null for extractors without a vocabulary, with `pca`, and to use the "
        "vocabulary that is shipped with `extractor`",
    )
    pca: int | None = Field(
        None,
        ge=1,
        le=MAX_PCA_DIMENSION,
        description="reduce the map's descriptors to this many dimensions, with the same "
        "vocabulary; null: full descriptors",
    )


@router.post("/vocabularies", status_code=202, dependencies=[WRITE, ADMIT_JOB])
def fit_vocabulary(
    gateway: GatewayDep,
    idempotent: IdempotentDep,
    query: MapQuery,
    options: FitVocabularyRequest | None = None,
) -> JobAcceptedResponse:
    """Fit a vocabulary on the map's own photos and switch to it.

    All photos are described again in the background while searches continue. The job succeeds when
    the new generation is active.
    """
    params = (options or FitVocabularyRequest.model_validate({})).model_dump()
    with gateway.catalog.write() as session:
        map_id = get_map(session, query.map).id
        if not has_live_photo(session, map_id, PhotoRole.DATABASE):
            raise Conflict("no_photos", "The map has no photos to fit on. Upload photos first.")
        job = start_model_change(session, map_id, JobKind.FIT, params)
        accepted = idempotent.accept_job(session, job)
    gateway.wakeups.send(JobMessage.of(job, query.map))
    return accepted


@router.post(
    "/vocabularies/import",
    status_code=202,
    openapi_extra=multipart_schema(
        "a `.npz` file of `placewise vocabulary export`, or a `.npy` file of "
        "(clusters, dimension) floats"
    ),
    dependencies=[WRITE, ADMIT_JOB],
)
async def import_vocabulary(
    request: Request,
    gateway: GatewayDep,
    idempotent: IdempotentFormDep,
    admission: AdmissionDep,
    query: MapQuery,
) -> JobAcceptedResponse:
    """Import a vocabulary from a `.npz` or `.npy` file and switch to it.

    The extractor validates it. The job fails with the reason if the shape does not match, or if by
    its metadata a `.npz` was fitted on other features than the extractor computes.
    """
    with admission.admit_upload(UploadKind.UPLOAD, request):
        async with receive_form_file(
            request, gateway.store, lambda _filename: new_vocabulary_key(), MAX_VOCABULARY_BYTES
        ) as file:
            return await run_in_threadpool(_queue_import, gateway, query.map, file, idempotent)


def _queue_import(
    gateway: GatewayContext, map_name: str, file: FormFile, idempotent: IdempotentRequest
) -> JobAcceptedResponse:
    upload = file.complete()
    params = {"object_key": upload.key, "filename": upload.filename}
    with idempotent.begin_form(upload), gateway.catalog.write() as session:
        map_id = get_map(session, map_name).id
        job = start_model_change(session, map_id, JobKind.IMPORT, params)
        accepted = idempotent.accept_job(session, job)
    gateway.wakeups.send(JobMessage.of(job, map_name))
    return accepted


@router.get("/vocabularies", dependencies=[READ])
def list_vocabularies(gateway: GatewayDep, query: MapQuery) -> list[VocabularyResponse]:
    """List the vocabularies of a map, newest first, with their provenance."""
    with gateway.catalog.read() as session:
        is_of_map = Vocabulary.map_id == get_map(session, query.map).id
        vocabularies = list_newest(session, Vocabulary, is_of_map)
    return [VocabularyResponse.model_validate(vocabulary) for vocabulary in vocabularies]


@router.get(
    "/vocabularies/{vocabulary_id}/file",
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
def get_vocabulary_file(gateway: GatewayDep, vocabulary_id: UUID, query: MapQuery) -> Response:
    """Download a vocabulary as a file for `POST /vocabularies/import`.

    It is a `.npz` with its provenance, or a `.npy` (`application/octet-stream`) if the provenance
    is unknown.
    """
    with gateway.catalog.read() as session:
        vocabulary = get_vocabulary(session, get_map(session, query.map).id, vocabulary_id)
    data, suffix = encode_vocabulary_file(
        gateway.store.get(vocabulary.object_key), vocabulary.sha256, vocabulary.provenance
    )
    return Response(
        data,
        media_type="application/zip" if suffix == ".npz" else "application/octet-stream",
        headers={"Content-Disposition": f'attachment; filename="{vocabulary.id}{suffix}"'},
    )


@router.get("/generations", dependencies=[READ])
def list_generations(gateway: GatewayDep, query: MapQuery) -> list[GenerationResponse]:
    """List the generations of a map, newest first."""
    with gateway.catalog.read() as session:
        is_of_map = Generation.map_id == get_map(session, query.map).id
        return [
            GenerationResponse.of_row(generation, photos=estimate_described(session, generation.id))
            for generation in list_newest(session, Generation, is_of_map)
        ]


@router.post("/generations", status_code=202, dependencies=[WRITE, ADMIT_JOB])
def start_generation(
    gateway: GatewayDep, idempotent: IdempotentDep, body: StartGenerationRequest, query: MapQuery
) -> JobAcceptedResponse:
    """Create a generation with another vocabulary, extractor or dimension, and switch to it.

    All photos are described again with a vocabulary of the map or with another extractor. With
    `pca`, the existing descriptors are reduced by PCA whitening that is fitted on them.
    """
    config = _validate_new_extractor(gateway.settings, body)
    with gateway.catalog.write() as session:
        map_id = get_map(session, query.map).id
        if body.pca is not None:
            gateway.settings.check_row_length(body.pca)
            job = _queue_pca(session, map_id, body.pca, body.vocabulary_id)
        else:
            gateway.settings.check_row_length(config.dimension if config else None)
            job = _queue_switch(session, map_id, config, body.vocabulary_id)
        accepted = idempotent.accept_job(session, job)
    gateway.wakeups.send(JobMessage.of(job, query.map))
    return accepted


def _validate_new_extractor(
    settings: Settings, body: StartGenerationRequest
) -> ExtractorConfig | None:
    """The requested extractor, or None; 422 if it is unknown or conflicts with other fields."""
    if body.extractor is None:
        return None
    if body.pca is not None:
        raise invalid_field_error(
            "pca", "is fitted on existing descriptors: switch to the extractor first"
        )
    try:
        config = settings.extractor_config(body.extractor)
    except Misconfigured as error:
        raise invalid_field_error("extractor", error.detail) from None
    if config.needs_vocabulary:
        if body.vocabulary_id is None and config.shipped_vocabulary is None:
            raise invalid_field_error(
                "vocabulary_id",
                f"is required, because {config.name} is shipped without a vocabulary: use one of "
                "the map (GET /api/v1/vocabularies), or fit one in a separate map",
            )
    elif body.vocabulary_id is not None:
        raise invalid_field_error("vocabulary_id", f"{config.name} uses no vocabulary: omit it")
    return config


def _queue_switch(
    session: Session, map_id: UUID, config: ExtractorConfig | None, vocabulary_id: UUID | None
) -> Job:
    params: dict[str, Any] = {"vocabulary_id": None}
    if vocabulary_id is not None:
        get_vocabulary(session, map_id, vocabulary_id)
        active = active_generation(session, map_id)
        # Not by undoing PCA, or describing all photos again: fits stay automatic.
        chosen = active is None or active.vocabulary_id != vocabulary_id
        params = {"vocabulary_id": str(vocabulary_id), "vocabulary_chosen": chosen}
    if config is not None:
        check_model_registered(session, config)
        params["extractor"] = config.name
    return start_model_change(session, map_id, JobKind.SWITCH, params)


def _queue_pca(session: Session, map_id: UUID, pca: int, vocabulary_id: UUID | None) -> Job:
    source = get_pca_source_generation(session, map_id)
    if vocabulary_id is not None and vocabulary_id != source.vocabulary_id:
        raise invalid_field_error(
            "vocabulary_id",
            "can't be combined with `pca`, which is fitted on the active descriptors: omit it, or "
            "switch to that vocabulary first",
        )
    if pca > source.dimension:
        raise invalid_field_error(
            "pca", f"{pca} is more than the {source.dimension} dimensions of the map's descriptors"
        )
    return start_model_change(session, map_id, JobKind.PCA, {"pca": pca})
