"""Alembic's environment script; `shared.catalog.database.schema.migrate` passes it a connection."""

from __future__ import annotations

from alembic import context

connection = context.config.attributes.get("connection")
if connection is None:
    raise SystemExit(
        "Run migrations with `placewise storage migrate`, which passes Alembic its connection, not "
        "with the alembic command."
    )
context.configure(connection=connection)
with context.begin_transaction():
    context.run_migrations()
