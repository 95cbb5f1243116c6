"""Alembic's entry point; `Catalog.migrate` and the migration test hand it their connection."""

from __future__ import annotations

from alembic import context

import shared.catalog.tables  # noqa: F401  (every table must be known)
from shared.catalog.base import Base

connection = context.config.attributes.get("connection")
if connection is None:
    raise SystemExit(
        "Migrations are run by Placewise itself (`placewise serve`, `Catalog.migrate`), "
        "which hands Alembic its connection."
    )
# SQLite can't alter most of a table in place: `render_as_batch` copies it instead.
context.configure(
    connection=connection,
    target_metadata=Base.metadata,
    render_as_batch=connection.dialect.name == "sqlite",
)
with context.begin_transaction():
    context.run_migrations()
