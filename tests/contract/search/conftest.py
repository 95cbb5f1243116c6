"""A search backend in process and over HTTP."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.search_api.protocol import SearchBackend
from shared.storage import FolderStore
from tests.support.search_tier import SearchTier


@pytest.fixture(params=["in process", "over HTTP"])
def backend(
    request: pytest.FixtureRequest, catalog: Catalog, store: FolderStore, settings: Settings
) -> Iterator[SearchBackend]:
    if request.param == "in process":
        yield SearchWorker(catalog, store, settings)
    else:
        with SearchTier(catalog, store, settings, 2) as tier:
            yield tier.port
