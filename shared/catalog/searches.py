"""Searches: what was asked, for the history and the figures; kept for SEARCH_HISTORY_DAYS."""

from __future__ import annotations

from datetime import datetime
from uuid import UUID

from sqlalchemy import Boolean, Float, ForeignKey, Index, Integer, Text, Uuid, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, UtcDateTime, db_now
from shared.ids import new_id


class Search(Base):
    """One answered similarity search."""

    __tablename__ = "searches"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"))
    generation_id: Mapped[UUID] = mapped_column(Uuid)
    query_photo_id: Mapped[UUID | None] = mapped_column(Uuid)
    query_filename: Mapped[str] = mapped_column(Text)
    top_k: Mapped[int] = mapped_column(Integer)
    results: Mapped[int] = mapped_column(Integer)
    processing_ms: Mapped[float] = mapped_column(Float)
    best_score: Mapped[float | None] = mapped_column(Float)
    in_map: Mapped[bool | None] = mapped_column(Boolean)
    searched_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    __table_args__ = (
        Index("ix_searches_map_time", "map_id", "searched_at"),
        Index("ix_searches_map_id", "map_id", "id"),
        Index("ix_searches_time", "searched_at"),
    )


def list_searches(
    session: Session, map_id: UUID, limit: int, before: UUID | None = None
) -> list[Search]:
    """Newest first, up to `limit`, older than `before`."""
    wanted = select(Search).where(Search.map_id == map_id)
    if before is not None:
        wanted = wanted.where(Search.id < before)
    return list(session.scalars(wanted.order_by(Search.id.desc()).limit(limit)))
