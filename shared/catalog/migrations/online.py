"""Creates and drops indexes without blocking traffic (PostgreSQL: CONCURRENTLY)."""

from __future__ import annotations

from typing import Any

from alembic import op
from sqlalchemy import text

# NULL: the index does not exist; false: its build was interrupted, and it is unusable.
IS_VALID = text("SELECT indisvalid FROM pg_index WHERE indexrelid = to_regclass(:name)")


def create_index(name: str, table: str, columns: list[Any], **options: Any) -> None:
    """Create the index without blocking writes.

    It runs outside of the migration's transaction, which ends before it. A migration with such an
    index therefore has to do nothing else, and can be run again after an interruption.
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
    """Drop the index without blocking reads or writes; see `create_index`."""
    context = op.get_context()
    if context.dialect.name == "sqlite":
        op.drop_index(name, table)
        return
    with context.autocommit_block():
        op.drop_index(name, table, postgresql_concurrently=True, if_exists=True)
