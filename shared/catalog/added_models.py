"""Models that were added: trained elsewhere, named once, fetched by whoever describes with them.

A name is given once and for all. Rows of descriptors, manifests and caches say `gsv:N`, so `N`
never comes to mean other weights, not even after the model was removed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from shared.catalog.base import db_now
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.models import Model
from shared.errors import Conflict, Misconfigured, NotFound
from shared.ids import new_id
from shared.model_names import PREFIX
from shared.recipes import Recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class NewModel:
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


def add_model(session: Session, new: NewModel) -> tuple[Model, bool]:
    """The model's row, and whether it was not there before.

    The same weights under the same name replace the file that is there, or come back after they
    were removed; with them come the licence and the note, where they are given. Conflict
    (`model_name_taken`) where the name means, or has meant, other weights.
    """
    found = _row(session, new.name, lock=True)
    if found is None:
        row = Model(
            id=new_id(),
            name=f"{PREFIX}{new.name}",
            fingerprint=new.fingerprint,
            licence=new.licence or "not said",
            card=new.card,
            added_name=new.name,
            added_at=db_now(),
            object_key=new.object_key,
            sha256=new.sha256,
            size_bytes=new.size_bytes,
            dimension=new.dimension,
            config=new.config,
            note=new.note,
        )
        try:
            with session.begin_nested():
                session.add(row)
                session.flush()
        except IntegrityError:  # another worker was first
            found = _row(session, new.name, lock=True)
            assert found is not None
        else:
            return row, True
    if found.fingerprint != new.fingerprint:
        gone = "" if found.object_key else ", which were removed, and names are not used again"
        raise Conflict(
            "model_name_taken",
            f"The name {new.name!r} belongs to other weights (fingerprint "
            f"{found.fingerprint[:12]}, these have {new.fingerprint[:12]}){gone}. Take another "
            "name.",
            model=new.name,
        )
    came_back = found.object_key is None
    found.object_key, found.sha256, found.size_bytes = new.object_key, new.sha256, new.size_bytes
    found.licence, found.note = new.licence or found.licence, new.note or found.note
    if came_back:
        found.added_at = db_now()
    session.flush()
    return found, came_back


def list_models(session: Session) -> list[Model]:
    """Every model that was added and not removed, by name."""
    return list(
        session.scalars(
            select(Model)
            .where(Model.added_name.is_not(None), Model.object_key.is_not(None))
            .order_by(Model.added_name)
        )
    )


def get_model(session: Session, name: str) -> Model:
    """The added model of that name; NotFound (`model_missing`)."""
    found = _row(session, name)
    if found is None or found.object_key is None:
        raise NotFound("model_missing", _missing(name), model=name)
    return found


def check_model(session: Session, recipe: Recipe) -> None:
    """NotFound (`model_missing`) where the recipe names a model that was not added."""
    if recipe.trained is not None and recipe.trained.registered is not None:
        get_model(session, recipe.trained.registered)


def model_to_load(session: Session, name: str, *, lock: bool = False) -> Model:
    """`get_model` for who describes photos: Misconfigured, as weights that are missing are.

    With `lock` it can't be removed before the transaction ends.
    """
    found = _row(session, name, lock=lock)
    if found is None or found.object_key is None:
        raise Misconfigured("model_missing", _missing(name), model=name)
    return found


def remove_model(session: Session, name: str, new_map_extractor: str) -> Model:
    """The model is gone from every list; its bytes go when the steward looks for orphans.

    NotFound (`model_missing`); Conflict (`model_in_use`) while a map is described with it, is
    about to be, or new maps are (`new_map_extractor`).
    """
    row = _row(session, name, lock=True)
    if row is None or row.object_key is None:
        raise NotFound("model_missing", _missing(name), model=name)
    maps = maps_using(session, row)
    if maps:
        raise Conflict(
            "model_in_use",
            f"The model {name!r} describes the photos of {_listed(maps)}. Switch them to another "
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


def maps_using(session: Session, model: Model) -> list[str]:
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


def _row(session: Session, name: str, *, lock: bool = False) -> Model | None:
    wanted = select(Model).where(Model.added_name == name)
    if lock:
        wanted = wanted.with_for_update().execution_options(populate_existing=True)
    return session.scalar(wanted)


def _missing(name: str) -> str:
    return (
        f"There is no model named {name!r} here. Add it: `placewise models add CHECKPOINT --name "
        f"{name}`, or POST /api/v1/models. GET /api/v1/models lists those that are there."
    )


def _listed(maps: list[str]) -> str:
    shown = ", ".join(repr(name) for name in maps[:5])
    return (
        ("the map " if len(maps) == 1 else "the maps ")
        + shown
        + (f" and {len(maps) - 5} more" if len(maps) > 5 else "")
    )
