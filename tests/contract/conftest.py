"""Fixtures of the contract tests."""

from __future__ import annotations

from uuid import UUID

import pytest

from shared.catalog.database.session import Catalog
from tests.support.catalog_rows import add_map


@pytest.fixture
def map_id(catalog: Catalog) -> UUID:
    with catalog.write() as session:
        return add_map(session).id
