"""Rows of the catalog as JSON values, the same from SQLite and PostgreSQL."""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import Column, Uuid

from shared.catalog.base import UtcDateTime


def to_json(value: Any) -> Any:
    """A column's value as JSON can hold it: UUIDs and times become text."""
    if isinstance(value, UUID):
        return str(value)
    if isinstance(value, datetime):
        return value.isoformat()
    return value


def from_json(column: Column[Any], value: Any) -> Any:
    """The value of `column` that `to_json` was given."""
    if value is None:
        return None
    if isinstance(column.type, Uuid):
        return UUID(value)
    if isinstance(column.type, UtcDateTime):
        return datetime.fromisoformat(value)
    return value
