"""Which releases understand the schema that is there; one row, written by migrations."""

from __future__ import annotations

from sqlalchemy import String
from sqlalchemy.orm import Mapped, mapped_column

from shared.catalog.base import Base


class SchemaCompatibility(Base):
    """`understood_from`: the oldest revision whose release works with the schema as it is now."""

    __tablename__ = "schema_compatibility"

    understood_from: Mapped[str] = mapped_column(String(32), primary_key=True)
