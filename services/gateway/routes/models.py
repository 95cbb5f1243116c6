"""Routes of the model registry: add, list and remove models.

The gateway stores an uploaded checkpoint and queues a job, but never loads it: an extractor
validates it (`services.extractor.added_models`).
"""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import APIRouter, Path, Request
from pydantic import BaseModel, ConfigDict, Field, field_validator
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import ADMIT_JOB, AdmissionDep, UploadKind
from services.gateway.authentication import ADMIN, READ
from services.gateway.dependencies import (
    ALL_MAPS,
    NO_NUL_PATTERN,
    NO_PARAMETERS,
    GatewayContext,
    GatewayDep,
    MapQuery,
)
from services.gateway.idempotency import IdempotentFormDep, IdempotentRequest
from services.gateway.responses import JobAcceptedResponse
from services.gateway.uploads.multipart import (
    FormFile,
    multipart_schema,
    parse_form,
    receive_form_file,
)
from shared.catalog.maps import get_map
from shared.catalog.models import (
    Model,
    get_registered_model,
    list_maps_using_model,
    list_registered_models,
    remove_model,
)
from shared.errors import PlacewiseError, TooLarge
from shared.extractor_config.names import MAX_NAME_CHARACTERS, MODEL_NAME_PATTERN, MODEL_NAME_RULE
from shared.jobs import Job, JobKind
from shared.jobs.wakeups import JobMessage
from shared.responses import ResponseModel
from shared.responses.maps import ModelResponse, RemovedModelResponse
from shared.storage.keys import new_checkpoint_key

# The largest backbone (ViT-g) has 4.5 GB of weights. Only admins add models.
MAX_CHECKPOINT_BYTES = 6_000_000_000
router = APIRouter(tags=["models"])

ModelNamePath = Annotated[
    str, Path(description="the model's name", min_length=1, max_length=100, pattern=NO_NUL_PATTERN)
]


def _model_response(session: Session, model: Model) -> ModelResponse:
    config = model.config or {}
    maps = list_maps_using_model(session, model)
    return ModelResponse.of_row(
        model,
        config=config,
        extractor=config.get("extractor", model.name),
        image_size=config.get("image_size"),
        maps=maps,
    )


class ModelForm(BaseModel):
    """The text fields of the form."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(
        description="maps use the model as gsv:NAME, torchscript:NAME or onnx:NAME; a name is "
        "never reused for other weights",
        json_schema_extra={"pattern": MODEL_NAME_PATTERN},
    )
    options: str | None = Field(
        None,
        max_length=MAX_NAME_CHARACTERS,
        pattern=NO_NUL_PATTERN,
        description="of a TorchScript or ONNX file: what its network expects, and the "
        "aggregator, such as input.size=288x288,aggregator=vlad",
    )
    licence: str | None = Field(
        None, max_length=1000, pattern=NO_NUL_PATTERN, description="licence of the weights"
    )
    note: str | None = Field(None, max_length=4000, pattern=NO_NUL_PATTERN, description="free text")

    @field_validator("name")
    @classmethod
    def _validate_name(cls, name: str) -> str:
        if not re.fullmatch(MODEL_NAME_PATTERN, name):
            raise ValueError(MODEL_NAME_RULE)
        return name


class ModelsResponse(ResponseModel):
    models: list[ModelResponse]


@router.post(
    "/models",
    status_code=202,
    openapi_extra=multipart_schema(
        "a checkpoint (`.ckpt`) of `placewise train`, a TorchScript or an `.onnx` file",
        ["name"],
        **ModelForm.model_json_schema()["properties"],
    ),
    dependencies=[ADMIN, ADMIT_JOB],
)
async def add_model(
    request: Request,
    gateway: GatewayDep,
    idempotent: IdempotentFormDep,
    admission: AdmissionDep,
    query: MapQuery,
) -> JobAcceptedResponse:
    """Add a model: upload its checkpoint, TorchScript or ONNX file with a `name`.

    An extractor validates it in a job of the map: it must be readable without executing code, its
    weights must be finite, and it must produce a descriptor. The code of a TorchScript file is
    executed, if CODE_ALLOWED lists its hash. The job fails with the reason if the file can't be
    used or the name belongs to other weights.
    """
    with admission.admit_upload(UploadKind.UPLOAD, request):
        async with receive_form_file(
            request,
            gateway.store,
            lambda _filename: new_checkpoint_key(),
            MAX_CHECKPOINT_BYTES,
            too_large=_checkpoint_too_large_error,
        ) as file:
            return await run_in_threadpool(_queue_model, gateway, query.map, file, idempotent)


def _queue_model(
    gateway: GatewayContext, map_name: str, file: FormFile, idempotent: IdempotentRequest
) -> JobAcceptedResponse:
    upload = file.complete()
    with idempotent.begin_form(upload), gateway.catalog.write() as session:
        job = Job(
            map_id=get_map(session, map_name).id,
            kind=JobKind.ADD_MODEL,
            params={
                "object_key": upload.key,
                "filename": upload.filename,
                "checkpoint_sha256": upload.sha256,
                **parse_form(ModelForm, upload.fields).model_dump(),
            },
        )
        accepted = idempotent.accept_job(session, job)
    gateway.wakeups.send(JobMessage.of(job, map_name))
    return accepted


@router.get("/models", dependencies=[READ, NO_PARAMETERS, ALL_MAPS])
def list_models(gateway: GatewayDep) -> ModelsResponse:
    """List the added models by name."""
    with gateway.catalog.read() as session:
        models = [_model_response(session, model) for model in list_registered_models(session)]
    return ModelsResponse(models=models)


@router.get("/models/{name}", dependencies=[READ, NO_PARAMETERS, ALL_MAPS])
def get_model(gateway: GatewayDep, name: ModelNamePath) -> ModelResponse:
    """Get one model."""
    with gateway.catalog.read() as session:
        return _model_response(session, get_registered_model(session, name))


@router.delete("/models/{name}", operation_id="remove_model", dependencies=[ADMIN, NO_PARAMETERS])
def delete_model(gateway: GatewayDep, name: ModelNamePath) -> RemovedModelResponse:
    """Remove a model; 409 (`model_in_use`) while a map uses it.

    Its name can be used again only for the same weights.
    """
    new_map_extractor = gateway.settings.new_map_extractor
    gateway.catalog.run(lambda session: remove_model(session, name, new_map_extractor))
    return RemovedModelResponse(
        success=True, message=f"The model {name} is removed.", removed_model=name
    )


def _checkpoint_too_large_error(max_bytes: int) -> PlacewiseError:
    return TooLarge(
        "file_too_large",
        f"The checkpoint is larger than {max_bytes} bytes. Save it without the state of the "
        "optimizer: placewise train --save_weights_only true.",
        max_bytes=max_bytes,
    )
