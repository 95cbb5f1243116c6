"""Evaluations: how often the right place came first, measured on a generation of a live map."""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import Boolean, ForeignKey, Index, Integer, Uuid, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now
from shared.ids import new_id


class Evaluation(Base):
    """The figures of one evaluation. `searchable` is how many photos could be found then."""

    __tablename__ = "evaluations"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
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


def list_evaluations(
    session: Session, map_id: UUID, limit: int, before: UUID | None = None
) -> list[Evaluation]:
    """Newest first, up to `limit`, older than `before`."""
    wanted = select(Evaluation).where(Evaluation.map_id == map_id)
    if before is not None:
        wanted = wanted.where(Evaluation.id < before)
    return list(session.scalars(wanted.order_by(Evaluation.id.desc()).limit(limit)))


def latest_evaluation(session: Session, generation_id: UUID) -> Evaluation | None:
    """The generation's newest one."""
    return session.scalar(
        select(Evaluation)
        .where(Evaluation.generation_id == generation_id)
        .order_by(Evaluation.id.desc())
        .limit(1)
    )
