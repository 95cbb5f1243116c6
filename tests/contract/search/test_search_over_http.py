"""Search over HTTP, with one shard and with three, keeps the contract of a search backend."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

import pytest

from services.search.chunk_loader import ChunkLoader, StoredChunk
from shared.catalog.session import Catalog
from shared.codes.int8_codes import Int8Codes
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.search_api.protocol import Mode, SearchBackend
from shared.storage import FolderStore
from tests.contract.search.search_methods import int8_on_demand
from tests.contract.search.test_search_backend import OpenPort, SearchPortContract
from tests.support.search_tier import SearchTier
from tests.support.small_map import SmallMap, assert_answers, search_when_built, unit_rows


@pytest.mark.parametrize(
    ("catalog", "replicas"),
    [("sqlite", (1,)), ("postgresql", (2, 1, 1))],
    ids=["one shard", "three shards, one of them twice"],
    indirect=["catalog"],
)
class TestSearchOverHttp(SearchPortContract):
    """The same promises, with HTTP between and the map's slots spread over workers."""

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

    def test_codes_that_are_being_made_are_no_reason_to_leave_shards_out(
        self, places: SmallMap, port: OpenPort, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        int8_on_demand(monkeypatch)
        go_on = threading.Event()
        make = ChunkLoader.load_int8_codes

        def slowly(self: ChunkLoader, object_key: str, stored: StoredChunk) -> Int8Codes:
            assert go_on.wait(60)
            return make(self, object_key, stored)

        monkeypatch.setattr(ChunkLoader, "load_int8_codes", slowly)
        for slot in range(3):
            places.add(unit_rows(slot, 10), slot=slot)
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector))
        request = request.model_copy(update={"mode": Mode.DETERMINISTIC})
        search = port(search_wait_seconds=0.2, search_timeout_seconds=1)
        try:
            with pytest.raises(Unavailable) as caught:
                search.search(request)
        finally:
            go_on.set()
        assert caught.value.code == "codes_being_made"
        assert caught.value.extra["retry_after_seconds"] >= 1
        response = search_when_built(search, request)
        assert_answers(response, places.brute_force(vector))
        assert response.certificate == "bound"
