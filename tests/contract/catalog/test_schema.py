"""A process that opens the catalog knows all its tables; creating them twice changes nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from shared.catalog.database.base import Base
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog

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


def test_migrating_twice_changes_nothing(catalog: Catalog) -> None:
    migrate(catalog)
