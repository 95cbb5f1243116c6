"""Routes of the model registry: add, list and remove models.

The gateway stores an uploaded checkpoint and queues a job, but never loads it: an extractor
validates it (`services.extractor.added_models`).
"""

from __future__ import annotations

import re
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
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
from services.gateway.uploads.multipart import FormFile, multipart_schema, receive_form_file
from shared.catalog.maps import get_map
from shared.catalog.models import (
    Model,
    get_registered_model,
    list_maps_using_model,
    list_registered_models,
    remove_model,
)
from shared.errors import PlacewiseError, TooLarge, invalid_field_error
from shared.extractor_config.names import (
    MAX_NAME_CHARACTERS,
    MODEL_NAME_PATTERN,
    MODEL_NAME_RULE,
)
from shared.ids import new_id
from shared.jobs import Job, JobKind, Priority
from shared.jobs.wakeups import JobMessage
from shared.responses import ResponseModel
from shared.responses.maps import ModelResponse, RemovedModelResponse
from shared.storage.keys import new_checkpoint_key

# The largest backbone (ViT-g) has 4.5 GB of weights. Only admins add models.
MAX_CHECKPOINT_BYTES = 6_000_000_000
MAX_LICENCE_CHARACTERS = 1000
MAX_NOTE_CHARACTERS = 4000
MODEL_FORM_FIELDS: dict[str, dict[str, Any]] = {
    "name": {
        "type": "string",
        "pattern": MODEL_NAME_PATTERN,
        "description": "maps use the model as gsv:NAME, torchscript:NAME or onnx:NAME; a name is "
        "never reused for other weights",
    },
    "options": {
        "type": "string",
        "maxLength": MAX_NAME_CHARACTERS,
        "description": "of a TorchScript or ONNX file: what its network expects, and the "
        "aggregator, such as input.size=288x288,aggregator=vlad",
    },
    "licence": {
        "type": "string",
        "maxLength": MAX_LICENCE_CHARACTERS,
        "description": "licence of the weights",
    },
    "note": {"type": "string", "maxLength": MAX_NOTE_CHARACTERS, "description": "free text"},
}

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


class ModelsResponse(ResponseModel):
    models: list[ModelResponse]


@router.post(
    "/models",
    operation_id="add_model",
    status_code=202,
    openapi_extra=multipart_schema(
        "a checkpoint (`.ckpt`) of `placewise train`, a TorchScript or an `.onnx` file",
        ["name"],
        **MODEL_FORM_FIELDS,
    ),
    dependencies=[ADMIN, ADMIT_JOB],
)
async def upload_model(
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
            id=new_id(),
            map_id=get_map(session, map_name).id,
            kind=JobKind.ADD_MODEL,
            priority=Priority.MODEL_CHANGE,
            params={
                "object_key": upload.key,
                "filename": upload.filename,
                "checkpoint_sha256": upload.sha256,
                **_parse_model_fields(upload.fields),
            },
        )
        accepted = idempotent.accept_job(session, job)
    gateway.wakeups.send(JobMessage.of(job, map_name))
    return accepted


@router.get("/models", operation_id="list_models", dependencies=[READ, NO_PARAMETERS, ALL_MAPS])
def read_models(gateway: GatewayDep) -> ModelsResponse:
    """List the added models by name."""
    with gateway.catalog.read() as session:
        models = [_model_response(session, model) for model in list_registered_models(session)]
    return ModelsResponse(models=models)


@router.get(
    "/models/{name}", operation_id="get_model", dependencies=[READ, NO_PARAMETERS, ALL_MAPS]
)
def read_model(gateway: GatewayDep, name: ModelNamePath) -> ModelResponse:
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


def _parse_model_fields(fields: dict[str, str]) -> dict[str, str | None]:
    """Validate and return the fields `name`, `options`, `licence` and `note` of the form."""
    for field in fields.keys() - MODEL_FORM_FIELDS.keys():
        raise invalid_field_error(field, f"is unknown; valid are {', '.join(MODEL_FORM_FIELDS)}")
    name = fields.get("name", "")
    if not re.fullmatch(MODEL_NAME_PATTERN, name):
        raise invalid_field_error("name", MODEL_NAME_RULE)
    for field, max_characters in (
        ("options", MAX_NAME_CHARACTERS),
        ("licence", MAX_LICENCE_CHARACTERS),
        ("note", MAX_NOTE_CHARACTERS),
    ):
        value = fields.get(field, "")
        if len(value) > max_characters or "\x00" in value:
            raise invalid_field_error(
                field, f"must have at most {max_characters} characters, without NUL"
            )
    return {
        "name": name,
        "options": fields.get("options") or None,
        "licence": fields.get("licence") or None,
        "note": fields.get("note") or None,
    }


def _checkpoint_too_large_error(max_bytes: int) -> PlacewiseError:
    return TooLarge(
        "file_too_large",
        f"The checkpoint is larger than {max_bytes} bytes. Save it without the state of the "
        "optimizer: placewise train --save_weights_only true.",
        max_bytes=max_bytes,
    )
