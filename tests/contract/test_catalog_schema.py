"""The migrated schema is the one that the tables describe, on every database."""

from __future__ import annotations

from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

import shared.catalog.tables  # noqa: F401
from shared.catalog.base import Base
from shared.catalog.session import Catalog


def test_migrations_lead_to_the_tables_that_the_code_describes(catalog: Catalog) -> None:
    with catalog.engine.connect() as connection:
        difference = compare_metadata(MigrationContext.configure(connection), Base.metadata)
    assert difference == []


def test_migrating_twice_changes_nothing(catalog: Catalog) -> None:
    catalog.migrate()
