"""Search on a real Milvus keeps the contract that it keeps with milvus-lite."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from services.search.milvus import MilvusWorker
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


class TestSearchOnAMilvusServer(test_milvus.TestSearchOnMilvus):
    """The same promises of a server."""


# What the worker promises by itself: tests/contract has it.
for promise in (
    "search_in_a_map_without_photos_has_no_hits",
    "search_raises_search_behind_if_min_version_is_not_reached",
    "search_waits_for_min_version",
    "chunk_that_cannot_be_read_is_named_and_the_rest_served",
    "search_with_a_damaged_descriptor_is_refused",
    "search_with_a_deleted_descriptor_raises_gone",
    "reference_into_a_superseded_chunk_still_answers",
    "status_has_rows_versions_and_memory",
    "chunk_that_is_merged_while_it_is_looked_at_is_not_taken_for_written",
    "worker_that_may_not_write_waits_for_the_one_that_does",
):
    assert hasattr(TestSearchOnAMilvusServer, f"test_{promise}"), promise
    setattr(TestSearchOnAMilvusServer, f"test_{promise}", None)


test_expressions = test_milvus.test_expression_selects_the_photos_that_match_the_filter
test_levels = test_milvus.test_levels_of_place_labels_have_no_wildcards
