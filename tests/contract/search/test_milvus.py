"""Search on Milvus keeps the contract of a search backend, with milvus-lite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as how
from hypothesis import strategies as some
from pydantic import SecretStr

from services.search.milvus import index as index_module
from services.search.milvus import query as query_module
from services.search.milvus.collections import Milvus, MilvusCollection
from services.search.milvus.expressions import filter_columns, filter_expression
from services.search.worker import SearchWorker
from shared.catalog.database.locks import hold_lock
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.photos import PhotoRole
from shared.config import search_settings
from shared.config.settings import Settings
from shared.errors import Conflict, Unavailable
from shared.search_api.photo_filter import PhotoFilter, is_part_of_tag
from shared.search_api.protocol import SearchBackend
from shared.storage import FolderStore
from tests.contract.search.test_search_backend import (
    OpenPort,
    SearchPortContract,
    whatever_the_catalog,
)
from tests.support.small_map import DIMENSION, SmallMap, assert_answers, unit_rows
from tests.unit.search.photo_filters import IDS, passes, photo_facts, photo_filters
from tests.unit.search.search_rows import facts_of


@pytest.fixture
def milvus_uri(tmp_path: Path) -> str:
    return f"{tmp_path}/milvus.db"


@pytest.fixture
def on_milvus(settings: Settings, milvus_uri: str) -> Settings:
    uri = SecretStr(milvus_uri)
    return settings.model_copy(update={"search_engine": "milvus", "milvus_uri": uri})


@pytest.fixture
def port(catalog: Catalog, store: FolderStore, on_milvus: Settings) -> OpenPort:
    def open_port(**options: Any) -> SearchBackend:
        options = {"max_wait_seconds": 60.0, **options}
        worker = SearchWorker(catalog, store, on_milvus, **options)
        worker.sync()  # creating a collection takes longer than the shortest of these waits
        return worker

    return open_port


@pytest.fixture
def milvus(on_milvus: Settings) -> Milvus:
    """The engine behind the worker's back."""
    return Milvus(on_milvus)


@pytest.fixture
def worker(catalog: Catalog, store: FolderStore, on_milvus: Settings) -> SearchWorker:
    return SearchWorker(catalog, store, on_milvus, max_wait_seconds=30.0)


def collection_of(milvus: Milvus) -> MilvusCollection:
    (name,) = milvus.names("placewise_")
    return MilvusCollection(milvus, name)


def complete(worker: SearchWorker) -> None:
    """Follow until nothing is missing; each sync writes a part."""
    for _ in range(100):
        worker.sync()
        if not worker.status().missing:
            return
    raise AssertionError(worker.status())


@whatever_the_catalog
class TestSearchOnMilvus(SearchPortContract):
    """The same promises where the rows are in an engine."""

    holds_rows = False

    def test_collection_that_was_dropped_is_filled_again_and_answers_say_what_is_missing(
        self,
        places: SmallMap,
        worker: SearchWorker,
        milvus: Milvus,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        for seed in range(3):
            places.add(unit_rows(seed, 5))
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector), k=20)
        assert_answers(worker.search(request), places.brute_force(vector, 20))
        lost = collection_of(milvus)
        milvus.drop(lost.name)
        with pytest.raises(Unavailable) as refused:
            worker.search(request)
        assert refused.value.code == "engine_unavailable"
        monkeypatch.setattr(index_module, "STEP_SECONDS", 0.0)
        worker.sync()
        assert collection_of(milvus).name != lost.name
        assert len(worker.status().missing) == 2
        response = worker.search(request)
        assert (response.certificate, len(response.missing)) == ("none", 2)
        assert len(response.hits) == 5
        complete(worker)
        assert_answers(worker.search(request), places.brute_force(vector, 20))

    def test_collection_that_is_being_filled_takes_in_what_changes_meanwhile(
        self, places: SmallMap, worker: SearchWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        photo_ids = [places.add(unit_rows(seed, 2))[0] for seed in range(5)]
        monkeypatch.setattr(index_module, "STEP_SECONDS", 0.0)
        worker.sync()
        assert worker.status().rows == 2
        places.delete(photo_ids[0])
        places.delete(photo_ids[4])
        places.patch(photo_ids[1], tags=["new"])
        (fresh,) = places.add(unit_rows(7, 1))  # is written first
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector), k=20)
        response = worker.search(request)
        assert fresh in {hit.photo_id for hit in response.hits}
        assert response.filling
        complete(worker)
        assert_answers(worker.search(request), places.brute_force(vector, 20))
        tagged = places.request(places.query(vector), k=20, tags=("new",))
        assert [hit.photo_id for hit in worker.search(tagged).hits] == [photo_ids[1]]

    def test_rows_that_are_too_long_are_refused_with_what_helps(
        self, places: SmallMap, worker: SearchWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for module in (index_module, search_settings):
            monkeypatch.setattr(module, "MAX_MILVUS_DIMENSION", DIMENSION - 1)
        places.add(unit_rows(1, 2))
        worker.sync()
        with pytest.raises(Conflict, match="maps switch NAME --pca 8192") as refused:
            worker.search(places.request(places.query(unit_rows(1, 1)[0])))
        assert refused.value.code == "rows_too_long"
        assert worker.status().loaded == {}, "such a generation is not switched to"

    def test_rows_that_were_lost_or_added_behind_our_back_are_counted_and_put_right(
        self,
        places: SmallMap,
        worker: SearchWorker,
        milvus: Milvus,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        photo_ids = places.add(unit_rows(1, 9)) + places.add(unit_rows(2, 9))
        complete(worker)
        collection = collection_of(milvus)
        collection.delete([photo_ids[3], photo_ids[12]])
        stray = facts_of(IDS[0])
        collection.put([{**filter_columns(stray), "vector": unit_rows(8, 1)[0]}])
        monkeypatch.setattr(index_module, "COUNT_SECONDS", 0.0)
        worker.sync()
        worker.sync()
        complete(worker)
        assert collection.all_photos() == set(photo_ids)
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector), k=20)
        assert_answers(worker.search(request), places.brute_force(vector, 20))

    def test_row_that_differs_from_its_chunk_is_not_vouched_for_and_written_again(
        self, places: SmallMap, worker: SearchWorker, milvus: Milvus
    ) -> None:
        photo_ids = places.add(unit_rows(1, 9))
        complete(worker)
        wrong = {**filter_columns(facts_of(photo_ids[3])), "vector": unit_rows(8, 1)[0]}
        collection_of(milvus).put([wrong])
        request = places.request(places.query(places.rows[photo_ids[3]]), k=20)
        response = worker.search(request)
        assert response.certificate == "none"
        assert_answers(response, places.brute_force(places.rows[photo_ids[3]], 20))
        worker.sync()
        complete(worker)
        assert worker.search(request).certificate == "exhaustive"

    def test_collections_of_generations_that_ended_are_dropped(
        self, places: SmallMap, worker: SearchWorker, milvus: Milvus
    ) -> None:
        places.add(unit_rows(1, 5))
        complete(worker)
        milvus.create("placewise_of_others_", 4, 1)
        with places.catalog.write() as session:
            session.get_one(Generation, places.generation_id).state = GenerationState.RETIRED
        worker.sync()
        (others,) = milvus.names("placewise_")
        assert others.startswith("placewise_of_others_")

    def test_two_workers_write_one_generation_together(
        self, places: SmallMap, catalog: Catalog, store: FolderStore, on_milvus: Settings
    ) -> None:
        workers = [SearchWorker(catalog, store, on_milvus, max_wait_seconds=60) for _ in range(2)]
        vector = unit_rows(9, 1)[0]
        for seed in range(4):
            photo_ids = places.add(unit_rows(seed, 5))
            places.delete(photo_ids[0])
            request = places.request(places.query(vector), k=50)
            for worker in workers[:: 1 if seed % 2 else -1]:
                assert_answers(worker.search(request), places.brute_force(vector, 50))
        assert [worker.status().rows for worker in workers] == [16, 16]

    def test_worker_that_may_not_write_waits_for_the_one_that_does(
        self,
        places: SmallMap,
        worker: SearchWorker,
        milvus: Milvus,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        places.add(unit_rows(1, 5))
        monkeypatch.setattr(index_module, "LOCK_SECONDS", 0.0)
        with hold_lock(places.catalog, places.generation_id, 1.0) as is_writer:
            assert is_writer
            worker._index.sync(places.generation_id, None)
            assert milvus.names("placewise_") == []
        complete(worker)
        assert len(milvus.names("placewise_")) == 1

    @pytest.mark.parametrize("index", ["HNSW", "IVF_FLAT"])
    def test_answers_of_an_approximate_index_say_so_and_its_recall_is_measured(
        self,
        places: SmallMap,
        catalog: Catalog,
        store: FolderStore,
        on_milvus: Settings,
        index: str,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        approximate = on_milvus.model_copy(update={"milvus_index": index})
        worker = SearchWorker(catalog, store, approximate, max_wait_seconds=60)
        places.add(unit_rows(1, 300))
        vector = unit_rows(2, 1)[0]
        response = worker.search(places.request(places.query(vector), k=10))
        assert response.certificate == "approximate"
        exact = places.brute_force(vector, 10)
        assert len({hit.photo_id for hit in response.hits} & {id_ for id_, _ in exact}) >= 5
        monkeypatch.setattr(index_module, "COUNT_SECONDS", 0.0)
        worker.sync()
        worker.sync()
        assert 0.5 <= worker.status().recalls[places.generation_id] <= 1


@whatever_the_catalog
@how(
    max_examples=120,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=some.data(), count=some.integers(1, 8))
def test_expression_selects_the_photos_that_match_the_filter(
    milvus: Milvus, data: some.DataObject, count: int
) -> None:
    """As the mask of the scan and SQL do, by the same reference."""
    collection = milvus.open("placewise_filters_") or milvus.create("placewise_filters_", 4, 1)
    photos = [data.draw(photo_facts(photo_id)) for photo_id in IDS[:count]]
    photo_filter = data.draw(photo_filters(photos))
    excluded = set(data.draw(some.lists(some.sampled_from(IDS), max_size=2)))
    collection.delete(IDS)
    vector = np.eye(1, 4, dtype=np.float32)[0]
    collection.put([{**filter_columns(photo), "vector": vector} for photo in photos])
    tags = sorted({tag for photo in photos for tag in photo.tags})
    condition = filter_expression(
        photo_filter, excluded, lambda part: [tag for tag in tags if is_part_of_tag(part, tag)]
    )
    hits = collection.search(vector, 50, condition)
    circle = photo_filter.near
    found = {h.photo_id for h in hits if circle is None or query_module.is_in_circle(h, circle)}
    for photo in photos:
        expected = passes(photo, photo_filter)
        if expected is not None:
            findable = photo.role == PhotoRole.DATABASE and photo.photo_id not in excluded
            assert (photo.photo_id in found) == (expected and findable), (photo, condition)


@whatever_the_catalog
@pytest.mark.parametrize("level", ["a", "a%", 'a"b', "a_", "ä/b\\", "a/b"])
def test_levels_of_place_labels_have_no_wildcards(milvus: Milvus, level: str) -> None:
    collection = milvus.open("placewise_levels_") or milvus.create("placewise_levels_", 4, 1)
    labels = [level, f"{level}/x", f"{level}x", f"{level}0", "aXb/x", "", level.upper(), "ä"]
    vector = np.eye(1, 4, dtype=np.float32)[0]
    rows = [facts_of(IDS[n], place=label) for n, label in enumerate(labels)]
    collection.put([{**filter_columns(photo), "vector": vector} for photo in rows])
    condition = filter_expression(PhotoFilter(place_under=level), (), lambda part: [])
    found = {hit.photo_id for hit in collection.search(vector, 50, condition)}
    assert found == {IDS[0], IDS[1]}
