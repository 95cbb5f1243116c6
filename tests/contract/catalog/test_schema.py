"""A process that opens the catalog knows all its tables; creating them twice changes nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from sqlalchemy import MetaData, Row, select
from sqlalchemy.schema import CreateTable

from shared.catalog.database.base import Base
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from tests.support.catalog_rows import add_map

ROOT = Path(__file__).parents[3]


OPEN = """
import json
from shared.catalog.database.base import Base
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
open_catalog(Settings(), "a service").close()
print(json.dumps(sorted(Base.metadata.tables)))
"""


def test_opening_the_catalog_registers_every_table() -> None:
    # In a process of its own: here the tests have imported them all.
    opened = subprocess.run(
        [sys.executable, "-c", OPEN], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert json.loads(opened.stdout) == sorted(Base.metadata.tables)


def test_migrating_twice_changes_neither_tables_nor_rows(catalog: Catalog) -> None:
    def read_all() -> dict[str, list[Row[Any]]]:
        found = MetaData()
        with catalog.read() as session:
            found.reflect(session.connection())
            return {
                str(CreateTable(table)): list(session.execute(select(table)))
                for table in found.sorted_tables
            }

    with catalog.write() as session:
        add_map(session)
    before = read_all()
    migrate(catalog)
    assert read_all() == before
