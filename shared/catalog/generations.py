r"""Generations (complete sets of a map's descriptors, by one extractor spec) and their evaluations.

BUILDING --complete, loaded by search--> ACTIVE --another is activated--> RETIRED --grace--> deleted
   \--its job is cancelled or fails--> ABANDONED --grace--> deleted
"""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import BigInteger, Boolean, ForeignKey, Index, Integer, String, Uuid, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Entity,
    Journaled,
    JsonValue,
    UtcDateTime,
    db_now,
    for_update,
    list_newest,
    partial_index,
)
from shared.enums import GenerationState as GenerationState
from shared.enums import RowType as RowType


class Generation(Journaled, Entity):
    """A generation. `spec` has everything that determines a descriptor's value.

    `calibration` is a `shared.evaluation.places.PlaceModel`, fitted by evaluations.
    """

    __tablename__ = "generations"

    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"), index=True)
    state: Mapped[GenerationState] = mapped_column(String(20))
    extractor: Mapped[str] = mapped_column(String(200))
    spec: Mapped[dict[str, Any]] = mapped_column(JsonValue)
    spec_fingerprint: Mapped[str] = mapped_column(String(64))
    dimension: Mapped[int] = mapped_column(Integer)
    row_type: Mapped[RowType] = mapped_column(
        String(20), default=RowType.FLOAT32, server_default=RowType.FLOAT32
    )
    """Type of its rows in new chunks; scores are exact for the rows as stored."""
    model_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("models.id"), index=True)
    vocabulary_id: Mapped[UUID | None] = mapped_column(
        Uuid, ForeignKey("vocabularies.id"), index=True
    )
    whitening_id: Mapped[UUID | None] = mapped_column(Uuid, ForeignKey("whitenings.id"), index=True)
    calibration: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    uses_matches: Mapped[bool | None] = mapped_column(Boolean)
    """Whether local features improve its answers; null until an evaluation has decided it."""
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    activated_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    ended_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    # The map's version and the time at which it first had every photo: search workers must have
    # loaded that version before it is activated.
    complete_version: Mapped[int | None] = mapped_column(BigInteger)
    complete_at: Mapped[datetime | None] = mapped_column(UtcDateTime)

    @property
    def pca_from(self) -> int | None:
        """Dimension of its descriptors before PCA; None without PCA.

        Taken from the spec, so also known after the whitening was deleted.
        """
        whitening = self.spec.get("whitening")
        return int(whitening["from_dimension"]) if whitening else None

    __table_args__ = (
        # One model change at a time: with two, each photo would be described three times.
        partial_index(
            "uq_generations_one_building",
            "map_id",
            only=state == GenerationState.BUILDING,
            unique=True,
        ),
        partial_index(
            "uq_generations_one_active", "map_id", only=state == GenerationState.ACTIVE, unique=True
        ),
    )


def active_generation(session: Session, map_id: UUID) -> Generation | None:
    """Return the map's active generation, if any."""
    return session.scalar(
        select(Generation).where(
            Generation.map_id == map_id, Generation.state == GenerationState.ACTIVE
        )
    )


def lock_generation(session: Session, generation_id: UUID) -> Generation:
    """Lock the generation's row until the end of the transaction, and return it refreshed."""
    return session.scalars(
        for_update(select(Generation).where(Generation.id == generation_id))
    ).one()


class Evaluation(Journaled, Entity):
    """The metrics of an evaluation; `searchable` is the number of searchable photos back then."""

    __tablename__ = "evaluations"

    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"))
    generation_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("generations.id"))
    automatic: Mapped[bool] = mapped_column(Boolean, default=False)
    searchable: Mapped[int] = mapped_column(Integer)
    labelled_queries: Mapped[int] = mapped_column(Integer)
    figures: Mapped[dict[str, Any]] = mapped_column(JsonValue)
    evaluated_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    __table_args__ = (
        Index("ix_evaluations_map_id", "map_id", "id"),
        Index("ix_evaluations_generation", "generation_id", "id"),
    )


def latest_evaluation(session: Session, generation_id: UUID) -> Evaluation | None:
    """Return the generation's newest evaluation, if any."""
    return next(
        iter(list_newest(session, Evaluation, Evaluation.generation_id == generation_id, limit=1)),
        None,
    )
