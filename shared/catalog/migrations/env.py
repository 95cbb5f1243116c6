"""Alembic's environment script; `shared.catalog.database.schema.migrate` passes it a connection."""

from __future__ import annotations

from typing import Any

from alembic import context
from sqlalchemy import delete, insert, inspect

import shared.catalog.tables  # noqa: F401  (registers every table)
from shared.catalog.database.base import Base
from shared.catalog.tables import SchemaCompatibility

connection = context.config.attributes.get("connection")
if connection is None:
    raise SystemExit(
        "Run migrations with `placewise migrate`, which passes Alembic its connection, not with "
        "the alembic command."
    )


def record_schema_compatibility(ctx: Any, step: Any, heads: Any, run_args: Any) -> None:
    """Record the oldest compatible revision of a migration, in the migration's transaction."""
    understood_from = getattr(step.up_revision.module, "understood_from", None)
    if understood_from and inspect(ctx.connection).has_table(SchemaCompatibility.__tablename__):
        ctx.connection.execute(delete(SchemaCompatibility))
        ctx.connection.execute(insert(SchemaCompatibility).values(understood_from=understood_from))


context.configure(
    connection=connection,
    target_metadata=Base.metadata,
    # SQLite can't alter most of a table in place: batch mode copies it instead.
    render_as_batch=connection.dialect.name == "sqlite",
    # Releases locks after each migration.
    transaction_per_migration=connection.dialect.name != "sqlite",
    on_version_apply=record_schema_compatibility,
)
with context.begin_transaction():
    context.run_migrations()
