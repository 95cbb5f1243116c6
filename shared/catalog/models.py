"""Models: the backbones that have described photos here, with their weights' fingerprint; and those
that were added (`shared.catalog.models`), whether or not they have described one.

Models that were added: trained elsewhere, named once, fetched by whoever describes with them.

A name is given once and for all. Rows of descriptors, manifests and caches say `gsv:N`, so `N`
never comes to mean other weights, not even after the model was removed.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import BigInteger, Index, Integer, String, Text, UniqueConstraint, Uuid, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, Journaled, JsonValue, UtcDateTime, db_now
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.errors import Conflict, Misconfigured, NotFound
from shared.extractor_config.configs import ExtractorConfig
from shared.extractor_config.names import TRAINED_MODEL_PREFIX
from shared.ids import new_id


class Model(Journaled, Base):
    """One set of weights. `card` says where they come from and under which licence.

    The columns from `added_name` on are those of a model that was added: its weights are a file of
    `shared.descriptors.vpr_models.checkpoint` under `object_key`, whose hash is `sha256`. A removed
    one keeps its row, without `object_key`: its name never comes to mean other weights.
    """

    __tablename__ = "models"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    fingerprint: Mapped[str] = mapped_column(String(64))
    licence: Mapped[str] = mapped_column(Text)
    card: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    first_used_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    added_name: Mapped[str | None] = mapped_column(String(100))
    added_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    object_key: Mapped[str | None] = mapped_column(Text)
    sha256: Mapped[str | None] = mapped_column(String(64))
    size_bytes: Mapped[int | None] = mapped_column(BigInteger)
    dimension: Mapped[int | None] = mapped_column(Integer)
    config: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    note: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (
        UniqueConstraint("name", "fingerprint"),
        Index("uq_models_added_name", "added_name", unique=True),
    )


def get_or_create_model(
    session: Session, name: str, fingerprint: str, licence: str, card: dict[str, Any]
) -> Model:
    """The row of these weights, made on first use."""
    known = select(Model).where(Model.name == name, Model.fingerprint == fingerprint)
    found = session.scalar(known)
    if found is not None:
        return found
    try:
        with session.begin_nested():
            made = Model(name=name, fingerprint=fingerprint, licence=licence, card=card)
            session.add(made)
            session.flush()
    except IntegrityError:  # another worker loaded the same weights
        return session.scalars(known).one()
    return made


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelRegistration:
    """What is known of a checkpoint that was checked and stored."""

    name: str
    fingerprint: str
    """sha256 of its configuration and weights, whatever file they came in."""
    object_key: str
    sha256: str
    """Of the stored object."""
    size_bytes: int
    dimension: int
    config: dict[str, Any]
    licence: str | None
    note: str | None
    card: dict[str, Any]


def register_model(session: Session, registration: ModelRegistration) -> tuple[Model, bool]:
    """The model's row, and whether it was not there before.

    The same weights under the same name replace the file that is there, or come back after they
    were removed; with them come the licence and the note, where they are given. Conflict
    (`model_name_taken`) where the name means, or has meant, other weights.
    """
    found = _find_model(session, registration.name, lock=True)
    if found is None:
        row = Model(
            id=new_id(),
            name=f"{TRAINED_MODEL_PREFIX}{registration.name}",
            fingerprint=registration.fingerprint,
            licence=registration.licence or "not said",
            card=registration.card,
            added_name=registration.name,
            added_at=db_now(),
            object_key=registration.object_key,
            sha256=registration.sha256,
            size_bytes=registration.size_bytes,
            dimension=registration.dimension,
            config=registration.config,
            note=registration.note,
        )
        try:
            with session.begin_nested():
                session.add(row)
                session.flush()
        except IntegrityError:  # another worker was first
            found = _find_model(session, registration.name, lock=True)
            assert found is not None
        else:
            return row, True
    if found.fingerprint != registration.fingerprint:
        gone = "" if found.object_key else ", which were removed, and names are not used again"
        raise Conflict(
            "model_name_taken",
            f"The name {registration.name!r} belongs to other weights (fingerprint "
            f"{found.fingerprint[:12]}, these have {registration.fingerprint[:12]}){gone}. "
            "Take another "
            "name.",
            model=registration.name,
        )
    came_back = found.object_key is None
    found.object_key, found.sha256, found.size_bytes = (
        registration.object_key,
        registration.sha256,
        registration.size_bytes,
    )
    found.licence, found.note = (
        registration.licence or found.licence,
        registration.note or found.note,
    )
    if came_back:
        found.added_at = db_now()
    session.flush()
    return found, came_back


def list_registered_models(session: Session) -> list[Model]:
    """Every model that was added and not removed, by name."""
    return list(
        session.scalars(
            select(Model)
            .where(Model.added_name.is_not(None), Model.object_key.is_not(None))
            .order_by(Model.added_name)
        )
    )


def get_registered_model(session: Session, name: str) -> Model:
    """The added model of that name; NotFound (`model_missing`)."""
    found = _find_model(session, name)
    if found is None or found.object_key is None:
        raise NotFound("model_missing", _model_missing_detail(name), model=name)
    return found


def check_model_registered(session: Session, recipe: ExtractorConfig) -> None:
    """NotFound (`model_missing`) where the recipe names a model that was not added."""
    if recipe.trained is not None and recipe.trained.registered is not None:
        get_registered_model(session, recipe.trained.registered)


def get_model_for_loading(session: Session, name: str, *, lock: bool = False) -> Model:
    """`get_registered_model` for who describes photos: Misconfigured, as weights that are
    missing are.

    With `lock` it can't be removed before the transaction ends.
    """
    found = _find_model(session, name, lock=lock)
    if found is None or found.object_key is None:
        raise Misconfigured("model_missing", _model_missing_detail(name), model=name)
    return found


def remove_model(session: Session, name: str, new_map_extractor: str) -> Model:
    """The model is gone from every list; its bytes go when the steward looks for orphans.

    NotFound (`model_missing`); Conflict (`model_in_use`) while a map is described with it, is
    about to be, or new maps are (`new_map_extractor`).
    """
    row = _find_model(session, name, lock=True)
    if row is None or row.object_key is None:
        raise NotFound("model_missing", _model_missing_detail(name), model=name)
    maps = list_maps_using_model(session, row)
    if maps:
        raise Conflict(
            "model_in_use",
            f"The model {name!r} describes the photos of {_join_names(maps)}. Switch them to "
            "another "
            "extractor first (POST /api/v1/generations), or delete them.",
            model=name,
            maps=maps,
        )
    if new_map_extractor == row.name:
        raise Conflict(
            "model_in_use",
            f"New maps are described with the model {name!r} (EXTRACTOR). Set another one first.",
            model=name,
            maps=[],
        )
    row.object_key = None
    session.flush()
    return row


def list_maps_using_model(session: Session, model: Model) -> list[str]:
    """Names of the live maps whose photos it describes, or will: by a generation that answers or
    is being built, or by the extractor of a map that has none yet."""
    of_generations = (
        select(Map.name)
        .join(Generation, Generation.map_id == Map.id)
        .where(
            Map.deleted_at.is_(None),
            Generation.model_id == model.id,
            Generation.state.in_((GenerationState.ACTIVE, GenerationState.BUILDING)),
        )
    )
    of_maps = select(Map.name).where(Map.deleted_at.is_(None), Map.extractor == model.name)
    return sorted({*session.scalars(of_generations), *session.scalars(of_maps)})


def _find_model(session: Session, name: str, *, lock: bool = False) -> Model | None:
    wanted = select(Model).where(Model.added_name == name)
    if lock:
        wanted = wanted.with_for_update().execution_options(populate_existing=True)
    return session.scalar(wanted)


def _model_missing_detail(name: str) -> str:
    return (
        f"There is no model named {name!r} here. Add it: `placewise models add CHECKPOINT --name "
        f"{name}`, or POST /api/v1/models. GET /api/v1/models lists those that are there."
    )


def _join_names(maps: list[str]) -> str:
    shown = ", ".join(repr(name) for name in maps[:5])
    return (
        ("the map " if len(maps) == 1 else "the maps ")
        + shown
        + (f" and {len(maps) - 5} more" if len(maps) > 5 else "")
    )
