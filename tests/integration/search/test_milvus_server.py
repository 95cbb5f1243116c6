"""Search on a real Milvus keeps the contract that it keeps with milvus-lite."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from services.search.milvus.worker import MilvusWorker
from tests.contract.search import test_milvus
from tests.contract.search.test_milvus import collections, on_milvus, port, worker
from tests.support.servers.milvus import MilvusServer

__all__ = ["on_milvus", "port", "worker"]
pytestmark = pytest.mark.databases("sqlite")


@pytest.fixture
def milvus_uri(milvus_server: MilvusServer) -> str:
    return milvus_server.url


@pytest.fixture(autouse=True)
def _no_collections(worker: MilvusWorker) -> Iterator[None]:
    yield
    for name in collections(worker):
        worker.client.drop_collection(name)


class TestSearchOnAMilvusServer(test_milvus.MilvusContract):
    """The same promises of a server."""


test_expressions = test_milvus.test_expression_selects_the_photos_that_match_the_filter
test_levels = test_milvus.test_levels_of_place_labels_have_no_wildcards
