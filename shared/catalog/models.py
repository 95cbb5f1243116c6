"""Models: the backbones that have described photos here, with their weights' fingerprint; and those
that were added (`shared.catalog.added_models`), whether or not they have described one.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import BigInteger, Index, Integer, String, Text, UniqueConstraint, Uuid, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now
from shared.catalog.journaled import Journaled
from shared.ids import new_id


class Model(Journaled, Base):
    """One set of weights. `card` says where they come from and under which licence.

    The columns from `added_name` on are those of a model that was added: its weights are a file of
    `shared.vision.place_models.model_file` under `object_key`, whose hash is `sha256`. A removed
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
