"""Reconstructions: COLMAP models of a map's photos, by which a query's pose is computed.

The objects are under `reconstruction_prefix(id)` (`shared.storage.keys`). A job continues its row
until `finished_at` is set; from then on the row does not change.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.chunks import count_searchable, find_features_model
from shared.catalog.database.base import Entity, Journaled, JsonValue, UtcDateTime, db_now
from shared.catalog.generations import Generation, active_generation
from shared.errors import Conflict, NotFound
from shared.storage import ObjectStore
from shared.storage.keys import reconstruction_prefix

MIN_PHOTOS = 3
HOW = "`placewise reconstruct`, or Reconstruction under Advanced on the page"
MAX_PHOTOS = 3000
"""Of a map that is reconstructed: the time of bundle adjustment grows faster than their number"""


class ComponentAlignment(BaseModel):
    """How a component lies on the earth."""

    model_config = ConfigDict(frozen=True)

    origin: tuple[float, float, float]
    """latitude and longitude in degrees, altitude in metres: where east, north and up are 0"""
    similarity: dict[str, Any]
    """`shared.geometry.frames.Similarity.as_json`: from the component to east, north and up"""
    rms_m: float
    """root of the mean squared distance of the photos that agree from their coordinates"""
    agreeing: int
    """photos that agree with their coordinates"""
    located: int
    """photos that have coordinates"""
    is_on_line: bool
    """whether only upright cameras settle the turn about the line on which the photos are"""


class ReconstructedComponent(BaseModel):
    """A component: photos and points in one frame. No two components share a photo."""

    model_config = ConfigDict(frozen=True)

    number: int
    """from 0"""
    object_key: str
    """of its `shared.geometry.component.Component`"""
    sha256: dict[str, str]
    """SHA-256 of this object and of those of its COLMAP model, hexadecimal, by key"""
    photos: int
    points: int
    mean_reprojection_error_pixels: float
    alignment: ComponentAlignment | None = None
    not_aligned: str | None = None
    """why there is no alignment, as a sentence; None with one"""
    calibration: dict[str, Any] | None = None
    """a `shared.geometry.radius.PoseCalibration`; None if it could not be measured"""


class Reconstruction(Journaled, Entity):
    """A reconstruction of a map's photos.

    `features_model` is that of the local features that its points refer to: no query with features
    of another model has a pose in it. `components` is None until they are stored, and then a list
    of `ReconstructedComponent`, largest first; `proposals` lists other coordinates for photos that
    disagree with the model.
    """

    __tablename__ = "reconstructions"

    map_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("maps.id"))
    job_id: Mapped[UUID] = mapped_column(sa.Uuid, index=True)
    generation_id: Mapped[UUID] = mapped_column(
        sa.Uuid, sa.ForeignKey("generations.id"), index=True
    )
    map_version: Mapped[int] = mapped_column(sa.BigInteger)
    features_model: Mapped[str] = mapped_column(sa.String(100))
    imported: Mapped[bool] = mapped_column(sa.Boolean, default=False)
    """Whether its poses come from a model that was uploaded."""
    components: Mapped[list[dict[str, Any]] | None] = mapped_column(JsonValue)
    proposals: Mapped[list[dict[str, Any]]] = mapped_column(JsonValue, default=list)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    finished_at: Mapped[datetime | None] = mapped_column(UtcDateTime)

    __table_args__ = (sa.Index("ix_reconstructions_map_id", "map_id", "id"),)

    def list_components(self) -> list[ReconstructedComponent]:
        """Return the components, largest first; empty until they are stored."""
        return [ReconstructedComponent.model_validate(one) for one in self.components or ()]

    def list_object_keys(self, store: ObjectStore) -> list[str]:
        """Return the keys of all its objects, whether it is finished or not."""
        return [info.key for info in store.list(reconstruction_prefix(self.id))]


def gives_coordinates(session: Session, map_id: UUID) -> bool:
    """Return whether poses in the map have coordinates and radii, at least in a component."""
    current = find_reconstruction(session, map_id)
    return current is not None and any(
        each.alignment and each.calibration for each in current.list_components()
    )


def check_reconstructable(session: Session, map_id: UUID) -> tuple[Generation, str]:
    """Return the active generation and the model of its local features, to reconstruct its photos.

    Raises:
        Conflict: `too_few_photos`, `too_many_photos`, `no_local_features`.
    """
    active = active_generation(session, map_id)
    photos = count_searchable(session, active.id) if active else 0
    if active is None or photos < MIN_PHOTOS:
        raise Conflict(
            "too_few_photos",
            f"The map has {photos} described photos, and a reconstruction needs {MIN_PHOTOS}. "
            "Upload photos, and wait for their jobs.",
        )
    if photos > MAX_PHOTOS:
        raise Conflict(
            "too_many_photos",
            f"The map has {photos} photos, and a reconstruction takes at most {MAX_PHOTOS}: its "
            "time grows faster than their number. Make a map of each site or floor.",
        )
    model = find_features_model(session, active.id)
    if model is None:
        raise Conflict(
            "no_local_features",
            "The map's photos have no local features, of which a reconstruction is made. Switch "
            'matching on: PATCH /api/v1/maps/{name} with {"matching": "on"}, or `placewise maps '
            "update NAME --matching on`.",
        )
    return active, model


def find_reconstruction(session: Session, map_id: UUID) -> Reconstruction | None:
    """Return the reconstruction for queries of the map now.

    It is the newest finished one for the local features of the active generation.
    """
    model = _features_model(session, map_id)
    finished = _newest_finished(map_id).where(Reconstruction.features_model == model)
    return None if model is None else session.scalar(finished)


def get_reconstruction(session: Session, map_id: UUID) -> Reconstruction:
    """Return `find_reconstruction`; NotFound (`no_reconstruction`) says why there is none."""
    if (current := find_reconstruction(session, map_id)) is not None:
        return current
    reason = f"The map has no reconstruction yet. Make one: {HOW}."
    if (other := session.scalar(_newest_finished(map_id))) is not None:
        reason = (
            f"The map's reconstruction is of local features of {other.features_model}, and the map "
            f"now has {_features_model(session, map_id) or 'none'}. Make a new one: {HOW}."
        )
    raise NotFound("no_reconstruction", reason)


def _newest_finished(map_id: UUID) -> sa.Select[Reconstruction]:
    finished = Reconstruction.map_id == map_id, Reconstruction.finished_at.is_not(None)
    return sa.select(Reconstruction).where(*finished).order_by(Reconstruction.id.desc()).limit(1)


def _features_model(session: Session, map_id: UUID) -> str | None:
    active = active_generation(session, map_id)
    return None if active is None else find_features_model(session, active.id)
