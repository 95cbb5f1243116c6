"""Model registry: the models that have described photos, and trained models that users added.

The name of an added model is permanent: descriptors, manifests and caches refer to it as
`gsv:NAME`, or by the prefix of its format, so NAME is never reused for other weights, even after
the model is removed.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Entity,
    Journaled,
    JsonValue,
    UtcDateTime,
    db_now,
    for_update,
    get_or_insert,
)
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.errors import Conflict, Misconfigured, NotFound, PlacewiseError
from shared.extractor_config.configs import ExtractorConfig, get_extractor_config
from shared.extractor_config.names import ModelName


class Model(Journaled, Entity):
    """A set of weights. `card` has their source and licence.

    The columns from `added_name` on are those of an added model: its weights are a file of
    `shared.descriptors.vpr_models.checkpoint`, or a TorchScript or ONNX file, under `object_key`,
    with the hash `sha256`. Its `config` has the `image_size`, and of an exported network the name
    of the `extractor` with the options that it was checked with. A removed model keeps its row,
    without `object_key`, to reserve its name.
    """

    __tablename__ = "models"

    name: Mapped[str] = mapped_column(sa.String(200))
    fingerprint: Mapped[str] = mapped_column(sa.String(64))
    licence: Mapped[str] = mapped_column(sa.Text)
    card: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    added_name: Mapped[str | None] = mapped_column(sa.String(100))
    added_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    object_key: Mapped[str | None] = mapped_column(sa.Text)
    sha256: Mapped[str | None] = mapped_column(sa.String(64))
    size_bytes: Mapped[int | None] = mapped_column(sa.BigInteger)
    dimension: Mapped[int | None] = mapped_column(sa.Integer)
    config: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    note: Mapped[str | None] = mapped_column(sa.Text)

    __table_args__ = (
        sa.UniqueConstraint("name", "fingerprint"),
        sa.Index("uq_models_added_name", "added_name", unique=True),
    )


def get_or_create_model(
    session: Session, name: str, fingerprint: str, licence: str, card: dict[str, Any]
) -> Model:
    """Return the row of these weights, created on first use."""
    statement = sa.select(Model).where(Model.name == name, Model.fingerprint == fingerprint)
    created = Model(name=name, fingerprint=fingerprint, licence=licence, card=card)
    return get_or_insert(session, statement, created)


def register_model(session: Session, new: Model) -> tuple[Model, bool]:
    """Register a model, or replace the file of a registered or removed model with these weights.

    The licence and the note are updated if they are given.

    Args:
        new: The row to add. Its fingerprint covers configuration and weights, whatever the format
            of the file; `sha256` is that of the stored object.

    Returns:
        The model's row, and whether the model is new or was removed before.

    Raises:
        Conflict: `model_name_taken`: the name belongs, or belonged, to other weights.
    """
    name, licence = str(new.added_name), new.licence
    new.licence = licence or "not stated"
    existing = get_or_insert(session, _select_model(name, lock=True), new)
    if existing is new:
        return new, True
    if existing.fingerprint != new.fingerprint:
        removed = "" if existing.object_key else "; they were removed, but names are not reused"
        raise Conflict(
            "model_name_taken",
            f"The name {name!r} belongs to other weights (fingerprint "
            f"{existing.fingerprint[:12]}, these have {new.fingerprint[:12]}){removed}. "
            "Choose another name.",
            model=name,
        )
    was_removed = existing.object_key is None
    existing.object_key = new.object_key
    existing.sha256 = new.sha256
    existing.size_bytes = new.size_bytes
    existing.config, existing.dimension = new.config, new.dimension
    existing.licence = licence or existing.licence
    existing.note = new.note or existing.note
    if was_removed:
        existing.added_at = db_now()
    session.flush()
    return existing, was_removed


def list_registered_models(session: Session) -> list[Model]:
    """List the added models that were not removed, by name."""
    return list(
        session.scalars(
            sa.select(Model)
            .where(Model.added_name.is_not(None), Model.object_key.is_not(None))
            .order_by(Model.added_name)
        )
    )


def get_registered_model(session: Session, name: str) -> Model:
    """Return the added model of this name; NotFound (`model_missing`)."""
    return _get_model(session, name, NotFound)


def check_model_registered(session: Session, config: ExtractorConfig) -> None:
    """Raise NotFound (`model_missing`) if the extractor uses a model that was not added."""
    if model := config.added_model:
        _get_model(session, str(model.registered), NotFound, prefix=model.prefix)


def get_model_for_loading(session: Session, model: ModelName, *, lock: bool = False) -> Model:
    """Return an added model by its registered name, for extractors.

    Args:
        lock: Lock the row, so that the model can't be removed before the transaction ends.

    Raises:
        Misconfigured: `model_missing`, as for other missing weights.
    """
    return _get_model(session, str(model.registered), Misconfigured, lock=lock, prefix=model.prefix)


def remove_model(session: Session, name: str, new_map_extractor: str) -> Model:
    """Remove an added model; the steward collects its object as an orphan.

    Raises:
        NotFound: `model_missing`.
        Conflict: `model_in_use`: a map or a running model change uses it, or `new_map_extractor`,
            the extractor of new maps, does.
    """
    row = _get_model(session, name, NotFound, lock=True)
    maps = list_maps_using_model(session, row)
    if maps:
        raise Conflict(
            "model_in_use",
            f"The model {name!r} describes the photos of {_join_names(maps)}. Switch them to "
            "another extractor first (POST /api/v1/generations), or delete them.",
            model=name,
            maps=maps,
        )
    if _uses(new_map_extractor, row):
        raise Conflict(
            "model_in_use",
            f"The model {name!r} is the extractor of new maps (EXTRACTOR). Set another one first.",
            model=name,
            maps=[],
        )
    row.object_key = None
    session.flush()
    return row


def list_maps_using_model(session: Session, model: Model) -> list[str]:
    """Return the names of the live maps that use the model, sorted.

    A map uses it with its active generation, a generation that is being built, or its extractor.
    """
    live = Map.deleted_at.is_(None)
    by_generation = (
        sa.select(Map.name, Generation.extractor)
        .join(Generation, Generation.map_id == Map.id)
        .where(
            live,
            Generation.extractor.contains(model.name, autoescape=True),
            Generation.state.in_((GenerationState.ACTIVE, GenerationState.BUILDING)),
        )
    )
    by_extractor = sa.select(Map.name, Map.extractor).where(
        live, Map.extractor.contains(model.name, autoescape=True)
    )
    rows = (*session.execute(by_generation), *session.execute(by_extractor))
    return sorted({name for name, extractor in rows if _uses(extractor, model)})


def _uses(extractor: str, model: Model) -> bool:
    """Return whether an extractor computes its descriptors with an added model."""
    try:
        config = get_extractor_config(extractor, allow_test_extractors=True)
    except PlacewiseError:  # of another release; one bad name must not hide all models
        return model.name in extractor
    return config.added_model is not None and config.added_model.extractor == model.name


def _select_model(name: str, *, lock: bool = False) -> sa.Select[Model]:
    statement = sa.select(Model).where(Model.added_name == name)
    return for_update(statement) if lock else statement


def _get_model(
    session: Session,
    name: str,
    missing: type[PlacewiseError],
    *,
    lock: bool = False,
    prefix: str = "",
) -> Model:
    """Return the added model of this name and kind; raise `missing` if there is none."""
    model = session.scalar(_select_model(name, lock=lock))
    if model is None or model.object_key is None or not model.name.startswith(prefix):
        raise missing(
            "model_missing",
            f"There is no model named {prefix}{name}. Add it: `placewise models add FILE --name "
            f"{name}`, or POST /api/v1/models. GET /api/v1/models lists the added models.",
            model=name,
        )
    return model


def _join_names(maps: list[str]) -> str:
    shown = ", ".join(repr(name) for name in maps[:5])
    return (
        ("the map " if len(maps) == 1 else "the maps ")
        + shown
        + (f" and {len(maps) - 5} more" if len(maps) > 5 else "")
    )
