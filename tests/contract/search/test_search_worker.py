"""The search worker keeps the contract with each method: dense and sign codes."""

from __future__ import annotations

import os
import threading
from typing import Any, BinaryIO

import pytest

from services.search import worker as worker_module
from services.search.catalog_sync import read_generation_versions, sync_snapshot
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, RowType
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.search_api.protocol import SearchBackend
from shared.storage import FolderStore, read_retries
from tests.contract.search.search_methods import always_by_codes
from tests.contract.search.test_search_backend import (
    AnswersContract,
    OpenPort,
    SearchPortContract,
    whatever_the_catalog,
)
from tests.support.small_map import SmallMap, assert_answers, damaged, unit_rows


@pytest.fixture
def port(catalog: Catalog, store: FolderStore, settings: Settings) -> OpenPort:
    def open_port(**options: Any) -> SearchBackend:
        # The first query of a process may wait until kernels are compiled.
        return SearchWorker(catalog, store, settings, **{"max_wait_seconds": 60.0, **options})

    return open_port


@whatever_the_catalog  # tests of search over HTTP run on PostgreSQL
class TestSearchWorker(SearchPortContract):
    def test_damaged_chunk_is_not_read_again_with_every_look_and_every_new_version(
        self, places: SmallMap, settings: Settings, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(
            read_retries, "FIRST_RETRY_SECONDS", read_retries.MAX_DAMAGED_RETRY_SECONDS
        )
        places.add(unit_rows(1, 5))
        (key,) = places.chunk_keys()
        places.store.put(key, damaged(places.store.get(key), "flipped"))
        opened: list[str] = []
        open_object = places.store.open

        def counted(key: str) -> BinaryIO:
            opened.append(key)
            return open_object(key)

        monkeypatch.setattr(places.store, "open", counted)
        worker = SearchWorker(places.catalog, places.store, settings)
        for seed in (2, 3):
            worker.sync()
            worker.sync()
            places.add(unit_rows(seed, 5))
            request = places.request(places.query(unit_rows(seed, 1)[0]), k=20)
            assert worker.search(request).missing == (key,)
        assert opened.count(key) == 1

    def test_chunk_that_is_truncated_while_it_is_mapped_is_left_out(
        self,
        places: SmallMap,
        store: FolderStore,
        settings: Settings,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """Reading such a mapping would end the process. A deleted file is read on."""
        monkeypatch.setattr(read_retries, "FIRST_RETRY_SECONDS", 0.0)
        monkeypatch.setattr(worker_module, "FILE_CHECK_SECONDS", 0.0)
        places.add(unit_rows(1, 5))
        retained = places.reference(places.add(unit_rows(2, 5))[0])[0]
        (key,) = set(places.chunk_keys()) - {retained}
        worker = SearchWorker(
            places.catalog, places.store, settings.model_copy(update={"search_memory_bytes": 0})
        )
        worker.sync()
        assert worker.status().rows == 10
        whole = places.store.get(key)
        os.truncate(store.path(key), 200)
        places.store.delete(retained)
        worker.sync()
        assert (worker.status().missing, worker.status().rows) == ((key,), 5)
        places.store.put(key, whole)
        worker.sync()
        assert (worker.status().missing, worker.status().rows) == ((), 10)

    def test_generations_that_are_no_longer_searched_are_unloaded(
        self, places: SmallMap, settings: Settings
    ) -> None:
        places.add(unit_rows(1, 5))
        worker = SearchWorker(places.catalog, places.store, settings)
        worker.sync()
        assert worker.status().versions == {places.generation_id: places.version}
        with places.catalog.write() as session:
            session.get_one(Generation, places.generation_id).state = GenerationState.RETIRED
        worker.sync()
        assert worker.status().versions == {}
        assert worker.status().resident_bytes == 0

    def test_followed_versions_reuse_the_chunks_that_are_loaded(
        self, places: SmallMap, settings: Settings
    ) -> None:
        first = places.add(unit_rows(1, 5))
        worker = SearchWorker(places.catalog, places.store, settings)
        worker.sync()
        places.store.delete(places.reference(first[0])[0])
        places.add(unit_rows(2, 5))
        worker.sync()
        assert worker.status().missing == (), "a loaded chunk was read again"
        assert worker.status().rows == 10


@whatever_the_catalog
def test_chunks_loaded_by_another_thread_during_a_sync_stay_loaded(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    always_by_codes(monkeypatch)  # with cached files
    places = SmallMap(catalog, store)
    places.add(unit_rows(1, 30))
    worker = SearchWorker(catalog, store, settings, max_wait_seconds=60)  # the kernels compile
    others: list[SmallMap] = []

    def read_before_another_map_is_searched(catalog: Catalog) -> Any:
        current = read_generation_versions(catalog)
        others.append(other := SmallMap(catalog, store))
        other.add(unit_rows(2, 30))
        worker.snapshot(other.generation_id, other.version)
        return current

    with monkeypatch.context() as patched:
        patched.setattr(
            worker_module, "read_generation_versions", read_before_another_map_is_searched
        )
        worker.sync()
    (other,) = others
    both = {each.generation_id: each.version for each in (places, other)}
    assert worker.status().versions == both
    cached = settings.search_cache_folder
    assert {folder.name for folder in cached.iterdir()} == set(map(str, both))
    with catalog.write() as session:
        session.get_one(Generation, other.generation_id).state = GenerationState.RETIRED
    worker.sync()
    assert worker.status().versions.keys() == {places.generation_id}
    assert [folder.name for folder in cached.iterdir()] == [str(places.generation_id)]


@whatever_the_catalog
def test_queries_wait_for_one_slow_load_no_longer_than_their_deadline(
    catalog: Catalog, store: FolderStore, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = SmallMap(catalog, store)
    places.add(unit_rows(1, 5))
    request = places.request(places.query(unit_rows(2, 1)[0]))
    worker = SearchWorker(places.catalog, places.store, settings, max_wait_seconds=0.1)
    goes_on, loads = threading.Event(), 0

    def load_slowly(*arguments: Any) -> Snapshot | None:
        nonlocal loads
        loads += 1
        goes_on.wait(60)
        return sync_snapshot(*arguments)

    monkeypatch.setattr(worker_module, "sync_snapshot", load_slowly)
    for _ in range(3):
        with pytest.raises(Unavailable) as refused:
            worker.search(request)
        assert refused.value.code == "search_behind"
    assert loads == 1
    goes_on.set()
    worker.sync()
    assert len(worker.search(request).hits) == 5
    assert loads == 1, "what was loaded for the refused queries is used"


@whatever_the_catalog
class TestSearchWorkerByCodes(AnswersContract):
    """The same promises where sign codes select the rows first."""

    certificate = "statistical"

    @pytest.fixture(autouse=True)
    def by_codes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        always_by_codes(monkeypatch)

    @pytest.mark.parametrize("damage", ["flipped", "truncated", "gone"])
    def test_damaged_or_missing_sign_codes_are_computed_again(
        self, places: SmallMap, port: OpenPort, settings: Settings, damage: str
    ) -> None:
        places.add(unit_rows(1, 30))
        vector = unit_rows(2, 1)[0]
        first = port().search(places.request(places.query(vector)))
        (path,) = settings.search_cache_folder.rglob("*.codes")
        whole = path.read_bytes()
        path.unlink()
        if damage != "gone":
            path.write_bytes(damaged(whole, damage))
        again = port().search(places.request(places.query(vector)))
        assert again == first
        assert path.read_bytes() == whole

    def test_search_compares_every_row_where_sign_codes_can_not_be_cached(
        self, places: SmallMap, port: OpenPort, settings: Settings
    ) -> None:
        places.add(unit_rows(1, 30))
        settings.search_cache_folder.parent.mkdir(parents=True, exist_ok=True)
        settings.search_cache_folder.write_text("no folder can be here")
        vector = unit_rows(2, 1)[0]
        response = port().search(places.request(places.query(vector)))
        assert_answers(response, places.brute_force(vector))
        assert response.certificate == "exhaustive"


@whatever_the_catalog
class TestSearchWorkerOfFloat16Rows(AnswersContract):
    """The same promises for rows that are stored in half precision, compared as they are stored."""

    length_error = 2.0**-11

    @pytest.fixture
    def places(self, catalog: Catalog, store: FolderStore) -> SmallMap:
        return SmallMap(catalog, store, RowType.FLOAT16)


class TestSearchWorkerOfFloat16RowsByCodes(TestSearchWorkerOfFloat16Rows):
    """The same promises where sign codes of such rows select the rows first."""

    certificate = "statistical"

    @pytest.fixture(autouse=True)
    def by_codes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        always_by_codes(monkeypatch)
