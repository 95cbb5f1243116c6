"""`/models`: models that were trained elsewhere and added, for maps to be described with.

The gateway stores what comes and queues a job; it never opens a checkpoint. An extractor checks it
(`services.extractor.add_model`).
"""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.context import DEFAULT_MAP, NO_NUL, Gateway, GatewayDep, MapName
from services.gateway.key_check import ADMIN, READ
from services.gateway.once import Once, OnceFormDep
from services.gateway.receive import describe_form, receive_file
from services.gateway.room import ROOM_FOR_JOBS, Kind, RoomDep
from services.gateway.schemas import Answer, JobStarted, started_job
from shared.catalog.added_models import get_model, list_models, maps_using, remove_model
from shared.catalog.maps import get_map
from shared.catalog.models import Model
from shared.errors import PlacewiseError, TooLarge, invalid_field
from shared.ids import new_id
from shared.jobs import Job, JobKind, Priority
from shared.model_names import MODEL_NAME, MODEL_NAME_RULE
from shared.objects.keys import new_checkpoint_key

MOST_LICENCE_CHARACTERS = 1000
MOST_NOTE_CHARACTERS = 4000
FIELDS: dict[str, dict[str, Any]] = {
    "name": {
        "type": "string",
        "pattern": MODEL_NAME,
        "description": "what maps call it: gsv:NAME. Given once, it never means other weights",
    },
    "licence": {
        "type": "string",
        "maxLength": MOST_LICENCE_CHARACTERS,
        "description": "of the weights",
    },
    "note": {"type": "string", "maxLength": MOST_NOTE_CHARACTERS, "description": "for people"},
}

router = APIRouter(tags=["models"])

ModelPath = Annotated[
    str, Path(description="the model's name", min_length=1, max_length=100, pattern=NO_NUL)
]


class ModelAnswer(Answer):
    name: str
    extractor: str = Field(description="what maps are described with: gsv:NAME")
    fingerprint: str = Field(description="sha256 of its configuration and weights")
    dimension: int = Field(description="numbers in one descriptor")
    image_size: tuple[int, int] = Field(description="height and width that photos are brought to")
    config: dict[str, Any] = Field(description="backbone and aggregator, as it was trained")
    size_bytes: int = Field(description="of its file in the object store")
    sha256: str = Field(description="of that file")
    licence: str
    note: str | None
    about: dict[str, Any] = Field(description="the file it came in, and how it was trained")
    added_at: datetime
    maps: list[str] = Field(description="maps that are described with it")

    @classmethod
    def of(cls, session: Session, model: Model) -> ModelAnswer:
        assert model.added_name is not None
        assert model.config is not None
        height, width = model.config["image_size"]
        return cls(
            name=model.added_name,
            extractor=model.name,
            fingerprint=model.fingerprint,
            dimension=model.dimension,
            image_size=(height, width),
            config=model.config,
            size_bytes=model.size_bytes,
            sha256=model.sha256,
            licence=model.licence,
            note=model.note,
            about=model.card,
            added_at=model.added_at,
            maps=maps_using(session, model),
        )


class ModelsAnswer(Answer):
    models: list[ModelAnswer]


class ModelRemoved(Answer):
    success: bool
    message: str
    removed_model: str


@router.post(
    "/models",
    operation_id="add_model",
    status_code=202,
    response_model=JobStarted,
    openapi_extra=describe_form(
        "a checkpoint (`.ckpt`) of `placewise train`",
        ["name"],
        **FIELDS,
    ),
    dependencies=[ADMIN, ROOM_FOR_JOBS],
)
async def add_model(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    once: OnceFormDep,
    room: RoomDep,
    map_name: MapName = DEFAULT_MAP,
) -> JobStarted:
    """Add a trained model: send a checkpoint, and a `name` for it.

    An extractor checks it, in a job of the map: that it can be read without executing anything,
    that its weights are finite and make a descriptor of a photo. One that can't be used ends the
    job as `failed` with the reason, and so does a name that belongs to other weights.
    """
    with room.receiving(Kind.UPLOAD, request):
        received = await receive_file(
            request,
            gateway.store,
            new_checkpoint_key(),
            gateway.settings.max_model_bytes,
            too_large=_too_large,
        )
    try:
        said = _read_fields(received.fields)
    except PlacewiseError:
        await run_in_threadpool(gateway.store.delete, received.key)
        raise
    await once.begin_form(gateway.store, received)
    params = {
        "object_key": received.key,
        "filename": received.filename,
        "checkpoint_sha256": received.sha256,
        **said,
    }
    job = await run_in_threadpool(_queue, gateway, map_name, params, once)
    gateway.hints.send()
    return started_job(response, job, map_name)


@router.get("/models", operation_id="list_models", response_model=ModelsAnswer, dependencies=[READ])
def models(gateway: GatewayDep) -> ModelsAnswer:
    """Every model that was added, by name."""
    with gateway.catalog.read() as session:
        found = [ModelAnswer.of(session, model) for model in list_models(session)]
    return ModelsAnswer(models=found)


@router.get(
    "/models/{name}", operation_id="get_model", response_model=ModelAnswer, dependencies=[READ]
)
def one_model(gateway: GatewayDep, name: ModelPath) -> ModelAnswer:
    """One model."""
    with gateway.catalog.read() as session:
        return ModelAnswer.of(session, get_model(session, name))


@router.delete(
    "/models/{name}",
    operation_id="remove_model",
    response_model=ModelRemoved,
    dependencies=[ADMIN],
)
def delete_model(gateway: GatewayDep, name: ModelPath) -> ModelRemoved:
    """Remove a model; 409 (`model_in_use`) while a map is described with it.

    Its name stays taken, unless the same weights are added again.
    """
    new_map_extractor = gateway.settings.new_map_extractor
    gateway.catalog.run(lambda session: remove_model(session, name, new_map_extractor))
    return ModelRemoved(success=True, message=f"The model {name} is removed.", removed_model=name)


def _read_fields(fields: dict[str, str]) -> dict[str, str | None]:
    """The name, the licence and the note that the form gives; 422 for what can't be taken."""
    for field in fields.keys() - FIELDS.keys():
        raise invalid_field(field, f"is none of {', '.join(FIELDS)}")
    name = fields.get("name", "")
    if not re.fullmatch(MODEL_NAME, name):
        raise invalid_field("name", MODEL_NAME_RULE)
    for field, most in (("licence", MOST_LICENCE_CHARACTERS), ("note", MOST_NOTE_CHARACTERS)):
        value = fields.get(field, "")
        if len(value) > most or "\x00" in value:
            raise invalid_field(field, f"has up to {most} characters, none of them NUL")
    return {
        "name": name,
        "licence": fields.get("licence") or None,
        "note": fields.get("note") or None,
    }


def _queue(gateway: Gateway, map_name: str, params: dict[str, Any], once: Once) -> Job:
    try:
        with gateway.catalog.write() as session:
            job = Job(
                id=new_id(),
                map_id=get_map(session, map_name).id,
                kind=JobKind.ADD_MODEL,
                priority=Priority.MODEL_CHANGE,
                params=params,
            )
            session.add(job)
            session.flush()
            once.keep_job(session, job)
            return job
    except PlacewiseError:
        gateway.store.delete(params["object_key"])
        raise


def _too_large(max_bytes: int) -> PlacewiseError:
    return TooLarge(
        "file_too_large",
        f"The checkpoint is larger than {max_bytes} bytes (MAX_MODEL_BYTES).",
        max_bytes=max_bytes,
    )
