"""Direct uploads: photos that callers send straight to the object store, and then complete.

The bytes arrive under a key of their own (`shared.objects.keys.incoming_key`). Completing copies
them, and keeps its answer here in the transaction that stores the photo.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import BigInteger, ForeignKey, Index, Integer, String, Text, Uuid, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now
from shared.errors import Gone, NotFound
from shared.ids import new_id


class PresignedUpload(Base):
    """A photo that was announced. `status` and `answer` are what completing it was answered."""

    __tablename__ = "direct_uploads"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"))
    filename: Mapped[str] = mapped_column(Text)
    size_bytes: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64))
    said: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    status: Mapped[int | None] = mapped_column(Integer)
    answer: Mapped[str | None] = mapped_column(Text)  # JSON, as it was sent
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    expires_at: Mapped[datetime] = mapped_column(UtcDateTime)

    __table_args__ = (
        Index("ix_direct_uploads_expires_at", "expires_at"),
        Index("ix_direct_uploads_map", "map_id"),
    )


def get_presigned_upload(
    session: Session, map_id: UUID, upload_id: UUID, *, lock: bool = False
) -> PresignedUpload:
    """An upload of the map that is completed, or can be still.

    Raises NotFound (`upload_not_found`) and Gone (`upload_expired`).
    """
    wanted = (
        select(PresignedUpload, (PresignedUpload.expires_at <= db_now()).label("expired"))
        .where(PresignedUpload.id == upload_id, PresignedUpload.map_id == map_id)
        .execution_options(populate_existing=True)
    )
    found = session.execute(wanted.with_for_update() if lock else wanted).one_or_none()
    if found is None:
        raise NotFound(
            "upload_not_found",
            f"There is no upload {upload_id} in this map. Begin one: POST /api/v1/uploads/presign.",
        )
    upload: PresignedUpload = found[0]
    if found.expired and upload.answer is None:
        raise Gone(
            "upload_expired",
            f"The upload {upload_id} was not completed in time. Begin another one: POST "
            "/api/v1/uploads/presign.",
        )
    return upload
