"""The tables that are created are those that the classes describe, on every database."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

import shared.catalog.tables  # noqa: F401
from shared.catalog.database.base import Base
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog

ROOT = Path(__file__).parents[3]


# PostgreSQL alone has it.
@pytest.mark.filterwarnings(
    "ignore:autogenerate skipping .* index 'ix_photos_(filename|relative_path)'"
)
def test_migrations_lead_to_the_tables_that_the_code_describes(catalog: Catalog) -> None:
    with catalog.engine.connect() as connection:
        difference = compare_metadata(MigrationContext.configure(connection), Base.metadata)
    # Alembic does not know that SQLite goes without the index of tags.
    elsewhere = {"ix_photos_tags"} if catalog.is_sqlite else set()
    assert [
        change for change in difference if getattr(change[1], "name", "") not in elsewhere
    ] == []


OPEN = """
import json
from shared.catalog.database.base import Base
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
open_catalog(Settings(), "a service").close()
print(json.dumps(sorted(Base.metadata.tables)))
"""


def test_whoever_opens_the_catalog_knows_every_table() -> None:
    # In a process of its own: here the tests have imported them all.
    opened = subprocess.run(
        [sys.executable, "-c", OPEN], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert json.loads(opened.stdout) == sorted(Base.metadata.tables)


def test_migrating_twice_changes_nothing(catalog: Catalog) -> None:
    migrate(catalog)
