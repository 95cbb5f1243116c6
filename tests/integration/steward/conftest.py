"""Fixtures of the steward's tests."""

from __future__ import annotations

import pytest

from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.storage import FolderStore
from tests.integration.evaluated_map import EvaluatedMap
from tests.integration.in_process_api import Service
from tests.integration.steward.batches import Batches
from tests.integration.steward.chunk_map import ChunkMap


@pytest.fixture
def chunk_map(catalog: Catalog, store: FolderStore) -> ChunkMap:
    return ChunkMap(catalog, store)


@pytest.fixture
def batches(service: Service, settings: Settings) -> Batches:
    return Batches(service, settings)


@pytest.fixture
def city(catalog: Catalog, store: FolderStore) -> EvaluatedMap:
    return EvaluatedMap(catalog, store)
