"""Search on Milvus keeps the contract of a search backend, with milvus-lite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr

from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.search_api.protocol import SearchBackend
from shared.storage import FolderStore
from tests.contract.search.test_search_backend import OpenPort, SearchPortContract


class TestSearchOnMilvus(SearchPortContract):
    """The same promises where the rows are in an engine."""

    holds_rows = False

    @pytest.fixture
    def port(
        self, catalog: Catalog, store: FolderStore, settings: Settings, tmp_path: Path
    ) -> OpenPort:
        on_milvus = settings.model_copy(
            update={"search_engine": "milvus", "milvus_uri": SecretStr(f"{tmp_path}/milvus.db")}
        )

        def open_port(**options: Any) -> SearchBackend:
            worker = SearchWorker(
                catalog, store, on_milvus, **{"max_wait_seconds": 60.0, **options}
            )
            worker.sync()  # creating a collection takes longer than the shortest of these waits
            return worker

        return open_port
