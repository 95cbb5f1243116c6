"""Alembic's entry point; `shared.catalog.schema.migrate` hands it a connection."""

from __future__ import annotations

from typing import Any

from alembic import context
from sqlalchemy import delete, insert, inspect

import shared.catalog.tables  # noqa: F401  (every table must be known)
from shared.catalog.base import Base
from shared.catalog.tables import SchemaCompatibility

connection = context.config.attributes.get("connection")
if connection is None:
    raise SystemExit(
        "Migrations are run by Placewise itself (`placewise migrate`), which hands Alembic its "
        "connection."
    )


def record_schema_compatibility(ctx: Any, step: Any, heads: Any, run_args: Any) -> None:
    """In the migration's own transaction: from which revision on releases can work with it."""
    understood_from = getattr(step.up_revision.module, "understood_from", None)
    if understood_from and inspect(ctx.connection).has_table(SchemaCompatibility.__tablename__):
        ctx.connection.execute(delete(SchemaCompatibility))
        ctx.connection.execute(insert(SchemaCompatibility).values(understood_from=understood_from))


context.configure(
    connection=connection,
    target_metadata=Base.metadata,
    # SQLite can't alter most of a table in place: a batch copies it instead.
    render_as_batch=connection.dialect.name == "sqlite",
    # Locks are held no longer than one migration takes.
    transaction_per_migration=connection.dialect.name != "sqlite",
    on_version_apply=record_schema_compatibility,
)
with context.begin_transaction():
    context.run_migrations()
