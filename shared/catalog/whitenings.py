"""PCA whitenings that a map's generations are made with, and where they lie."""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import Float, ForeignKey, Integer, String, Text, Uuid
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, UtcDateTime, db_now
from shared.catalog.generations import Generation, active_generation
from shared.catalog.journaled import Journaled
from shared.errors import Conflict
from shared.ids import new_id


class StoredWhitening(Journaled, Base):
    """From `dimension` numbers to `kept`: a file of `shared.vision.pca_file` under `object_key`.

    It goes when none of its generations answers or is built any more, some time after.
    """

    __tablename__ = "whitenings"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"), index=True)
    dimension: Mapped[int] = mapped_column(Integer)
    kept: Mapped[int] = mapped_column(Integer)
    # Those that it was fitted on, and the share of their variance that is left, 0 to 1.
    rows: Mapped[int] = mapped_column(Integer)
    explained: Mapped[float] = mapped_column(Float)
    object_key: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    def summary(self) -> dict[str, Any]:
        """What an answer says of it."""
        return {
            "from_dimension": self.dimension,
            "dimension": self.kept,
            "rows": self.rows,
            "explained": self.explained,
        }


def get_pca_source_generation(session: Session, map_id: UUID) -> Generation:
    """The active generation, whose rows a PCA can be fitted on.

    Conflict: `nothing_described` in a map without one; `already_reduced` where PCA has shortened
    its descriptors: what it has left out can't be had back from them.
    """
    active = active_generation(session, map_id)
    if active is None:
        raise Conflict(
            "nothing_described",
            "PCA is fitted on the map's descriptors, and it has none yet. Upload photos first.",
        )
    if active.pca_from is not None:
        raise Conflict(
            "already_reduced",
            f"PCA has brought the map's descriptors to {active.dimension} dimensions already. Go "
            "back to whole ones first: `placewise pca undo`, or POST /api/v1/generations with the "
            "vocabulary alone.",
            dimension=active.dimension,
        )
    return active


def add_whitening(session: Session, map_id: UUID, **columns: Any) -> StoredWhitening:
    """Make a whitening that lies under `object_key` known."""
    whitening = StoredWhitening(id=new_id(), map_id=map_id, **columns)
    session.add(whitening)
    session.flush()
    return whitening
