"""Indexes that are built and dropped while traffic goes on."""

from __future__ import annotations

from typing import Any

from alembic import op
from sqlalchemy import text

# NULL: there is none; false: a build was broken off, and the index is no good.
IS_VALID = text("SELECT indisvalid FROM pg_index WHERE indexrelid = to_regclass(:name)")


def create_index(name: str, table: str, columns: list[Any], **options: Any) -> None:
    """Build the index without keeping writers out (PostgreSQL: CONCURRENTLY).

    It takes no part in the migration's transaction, which ends before it. So a migration that has
    one does nothing else, and can begin again after it was broken off.
    """
    context = op.get_context()
    if context.dialect.name == "sqlite":
        op.create_index(name, table, columns, **options)
        return
    with context.autocommit_block():
        valid = op.get_bind().scalar(IS_VALID, {"name": name})
        if valid:
            return
        if valid is False:
            op.drop_index(name, table, postgresql_concurrently=True)
        op.create_index(name, table, columns, postgresql_concurrently=True, **options)


def drop_index(name: str, table: str) -> None:
    """Drop the index without keeping anyone out; see `create_index`."""
    context = op.get_context()
    if context.dialect.name == "sqlite":
        op.drop_index(name, table)
        return
    with context.autocommit_block():
        op.drop_index(name, table, postgresql_concurrently=True, if_exists=True)
