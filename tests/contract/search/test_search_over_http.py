"""Search over HTTP, with one shard and with three, keeps the contract of a search backend."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.search_api.protocol import SearchBackend
from shared.storage import FolderStore
from tests.contract.search.test_search_backend import OpenPort, SearchPortContract
from tests.support.search_tier import SearchTier


class TestSearchOverHttp(SearchPortContract):
    """The same promises, with HTTP between and the map's slots spread over workers."""

    @pytest.fixture
    def replicas(self, catalog_kind: str) -> tuple[int, ...]:
        """Of each shard: one shard on SQLite, three on PostgreSQL, the first of them twice."""
        return (1,) if catalog_kind == "sqlite" else (2, 1, 1)

    @pytest.fixture
    def port(
        self,
        replicas: tuple[int, ...],
        catalog: Catalog,
        store: FolderStore,
        settings: Settings,
    ) -> Iterator[OpenPort]:
        with contextlib.ExitStack() as running:

            def open_port(**changes: object) -> SearchBackend:
                # Whoever waits longer for a version waits longer for the shards, too.
                wait = float(str(changes.get("search_wait_seconds", settings.search_wait_seconds)))
                patience = {"search_timeout_seconds": max(10.0, 5 * wait)}
                own = settings.model_copy(update=patience | changes)
                tier = SearchTier(catalog, store, own, replicas)
                tier.follow()  # a search brings only one replica of a shard up to date
                return running.enter_context(tier).port

            yield open_port
