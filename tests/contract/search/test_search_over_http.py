"""Search over HTTP, with two workers, keeps the contract of a search backend."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

from services.search.worker import MAX_WAIT_SECONDS
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.search_api.client import SEARCH_TIMEOUT_SECONDS
from shared.search_api.protocol import SearchBackend
from shared.storage import FolderStore
from tests.contract.search.test_search_backend import OpenPort, SearchPortContract
from tests.support.search_tier import SearchTier

pytestmark = pytest.mark.databases("postgresql")
REPLICAS = 2


class TestSearchOverHttp(SearchPortContract):
    """The same promises, with HTTP between and a choice of workers."""

    @pytest.fixture
    def port(
        self,
        catalog: Catalog,
        store: FolderStore,
        settings: Settings,
        monkeypatch: pytest.MonkeyPatch,
    ) -> Iterator[OpenPort]:
        monkeypatch.setenv("ALL_PROXY", "http://127.0.0.1:1")  # not between services
        with contextlib.ExitStack() as running:

            def open_port(max_wait_seconds: float = MAX_WAIT_SECONDS) -> SearchBackend:
                # Whoever waits longer for a version waits longer for an answer, too.
                timeout_seconds = max(SEARCH_TIMEOUT_SECONDS, 5 * max_wait_seconds)
                tier = SearchTier(
                    catalog, store, settings, REPLICAS, max_wait_seconds, timeout_seconds
                )
                tier.follow()  # a search brings only one worker up to date
                return running.enter_context(tier).port

            yield open_port
