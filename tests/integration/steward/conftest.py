"""Fixtures of the steward's tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from services.extractor.worker import ExtractorWorker
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.config.settings import Settings
from shared.storage import FolderStore, OwnedStore
from shared.storage.s3 import S3Store
from tests.integration.evaluated_map import EvaluatedMap
from tests.integration.in_process_api import Service
from tests.integration.steward.batches import Batches
from tests.integration.steward.chunk_map import ChunkMap
from tests.support.servers import S3Server


@pytest.fixture
def chunk_map(catalog: Catalog, store: FolderStore) -> ChunkMap:
    return ChunkMap(catalog, store)


@pytest.fixture
def batches(service: Service, settings: Settings) -> Batches:
    return Batches(service, settings)


@pytest.fixture
def on_s3(
    catalog: Catalog,
    s3: S3Server,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> Batches:
    """As `batches`, with the objects in a bucket. No photo is described: extractors have others."""
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    store: OwnedStore = S3Store(s3.new_bucket())
    return Batches(Service(catalog, store, settings, make_worker), settings)


@pytest.fixture
def city(catalog: Catalog, store: FolderStore) -> EvaluatedMap:
    return EvaluatedMap(catalog, store)
