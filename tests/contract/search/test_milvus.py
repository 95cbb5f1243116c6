"""Search on Milvus keeps the contract of a search backend, with milvus-lite."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as how
from hypothesis import strategies as some
from pydantic import SecretStr

from services.search.milvus import worker as milvus_module
from services.search.milvus.collection import Collection
from services.search.milvus.filters import filter_columns, filter_expression
from services.search.milvus.worker import MilvusWorker
from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.photos import PhotoFilterValues, PhotoRole
from shared.config import search_settings
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured, Unavailable
from shared.search_api.photo_filter import Circle, PhotoFilter, is_part_of_tag
from shared.search_api.protocol import SearchBackend
from shared.storage import FolderStore
from tests.contract.search.test_search_backend import (
    AnswersContract,
    OpenPort,
    SearchPortContract,
    whatever_the_catalog,
)
from tests.support.small_map import DIMENSION, Rows, SmallMap, assert_answers, unit_rows
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
        worker = MilvusWorker(catalog, store, on_milvus, **options)
        worker.sync()  # creating a collection takes longer than the shortest of these waits
        return worker

    return open_port


@pytest.fixture
def worker(catalog: Catalog, store: FolderStore, on_milvus: Settings) -> MilvusWorker:
    return MilvusWorker(catalog, store, on_milvus, max_wait_seconds=30.0)


def collections(worker: MilvusWorker) -> list[str]:
    found = worker.client.list_collections()
    return sorted(name for name in found if name.startswith("placewise_"))


def collection_of(worker: MilvusWorker) -> str:
    (name,) = collections(worker)
    return name


def write(worker: MilvusWorker, photos: Sequence[PhotoFilterValues], vector: Rows) -> None:
    """Behind the worker's back."""
    rows = [{**filter_columns(photo), "vector": vector} for photo in photos]
    worker.client.upsert(collection_of(worker), rows)


def complete(worker: MilvusWorker) -> None:
    """Follow until nothing is missing; each sync writes a part."""
    for _ in range(100):
        worker.sync()
        if not worker.status().incomplete:
            return
    raise AssertionError(worker.status())


class MilvusContract(AnswersContract):
    """The promises that depend on Milvus."""

    holds_rows = False

    def test_collection_that_was_dropped_is_filled_again_and_answers_say_what_is_missing(
        self, places: SmallMap, worker: MilvusWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for seed in range(3):
            places.add(unit_rows(seed, 5))
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector), k=20)
        assert_answers(worker.search(request), places.brute_force(vector, 20))
        lost = collection_of(worker)
        with monkeypatch.context() as while_it_is_dropped:
            while_it_is_dropped.setattr(Collection, "search", lambda *_: [])
            while_it_is_dropped.setattr(Collection, "read_mark", lambda _: None)
            with pytest.raises(Unavailable, match="has lost its rows"):
                worker.search(request)
        worker.client.drop_collection(lost)
        with pytest.raises(Unavailable) as refused:
            worker.search(request)
        assert refused.value.code == "engine_unavailable"
        monkeypatch.setattr(milvus_module, "STEP_SECONDS", 0.0)
        worker.sync()
        assert collection_of(worker) != lost
        assert worker.status().unwritten == 2
        response = worker.search(request)
        assert (response.certificate, len(response.missing)) == ("none", 2)
        assert len(response.hits) == 5
        complete(worker)
        assert_answers(worker.search(request), places.brute_force(vector, 20))

    def test_collection_that_is_being_filled_takes_in_what_changes_meanwhile(
        self, places: SmallMap, worker: MilvusWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        photo_ids = [places.add(unit_rows(seed, 2))[0] for seed in range(5)]
        monkeypatch.setattr(milvus_module, "STEP_SECONDS", 0.0)
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
        self, places: SmallMap, worker: MilvusWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for module in (milvus_module, search_settings):
            monkeypatch.setattr(module, "MAX_MILVUS_DIMENSION", DIMENSION - 1)
        places.add(unit_rows(1, 2))
        worker.sync()
        with pytest.raises(Conflict, match="maps switch NAME --pca 8192") as refused:
            worker.search(places.request(places.query(unit_rows(1, 1)[0])))
        assert refused.value.code == "rows_too_long"
        assert worker.status().loaded == {}, "such a generation is not switched to"

    def test_rows_that_were_lost_or_added_behind_our_back_are_counted_and_put_right(
        self, places: SmallMap, worker: MilvusWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(milvus_module, "CHECK_SECONDS", 0.0)
        photo_ids = places.add(unit_rows(1, 9)) + places.add(unit_rows(2, 9))
        complete(worker)
        lost = [photo_id.hex for photo_id in (photo_ids[3], photo_ids[12])]
        worker.client.delete(collection_of(worker), ids=lost)
        write(worker, [facts_of(IDS[0])], unit_rows(8, 1)[0])
        worker.sync()
        assert worker.status().unwritten == 2
        complete(worker)
        there = worker.client.query(collection_of(worker), 'photo < "~"', output_fields=["photo"])
        assert {row["photo"] for row in there} == {photo_id.hex for photo_id in photo_ids}
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector), k=20)
        assert_answers(worker.search(request), places.brute_force(vector, 20))

    def test_row_that_differs_from_its_chunk_is_not_vouched_for_and_written_again(
        self, places: SmallMap, worker: MilvusWorker
    ) -> None:
        photo_ids = places.add(unit_rows(1, 9))
        complete(worker)
        write(worker, [facts_of(photo_ids[3])], unit_rows(8, 1)[0])
        request = places.request(places.query(places.rows[photo_ids[3]]), k=20)
        response = worker.search(request)
        assert response.certificate == "none"
        assert_answers(response, places.brute_force(places.rows[photo_ids[3]], 20))
        worker.sync()
        complete(worker)
        assert worker.search(request).certificate == "exhaustive"

    def test_collections_of_generations_that_ended_are_dropped(
        self, places: SmallMap, worker: MilvusWorker
    ) -> None:
        places.add(unit_rows(1, 5))
        complete(worker)
        Collection(worker.client, "placewise_of_others_1_FLAT").create(4, 1)
        with places.catalog.write() as session:
            session.get_one(Generation, places.generation_id).state = GenerationState.RETIRED
        worker.sync()
        assert collections(worker) == ["placewise_of_others_1_FLAT"]

    def test_chunk_that_is_merged_while_it_is_looked_at_is_not_taken_for_written(
        self, places: SmallMap, worker: MilvusWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for seed in range(3):
            places.add(unit_rows(seed, 5))
        write_chunks = worker._write_chunks

        def merge_first(*args: Any) -> set[str]:
            assert places.merge()
            return write_chunks(*args)

        with monkeypatch.context() as patched:
            patched.setattr(worker, "_write_chunks", merge_first)
            worker.sync()
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector), k=20, min_version=0)
        assert worker.search(request).certificate == "none"
        complete(worker)
        assert_answers(worker.search(request), places.brute_force(vector, 20))

    def test_two_workers_write_one_generation_together(
        self, places: SmallMap, catalog: Catalog, store: FolderStore, on_milvus: Settings
    ) -> None:
        workers = [MilvusWorker(catalog, store, on_milvus, max_wait_seconds=60) for _ in range(2)]
        vector = unit_rows(9, 1)[0]
        for seed in range(4):
            photo_ids = places.add(unit_rows(seed, 5))
            places.delete(photo_ids[0])
            request = places.request(places.query(vector), k=50)
            for worker in workers[:: 1 if seed % 2 else -1]:
                assert_answers(worker.search(request), places.brute_force(vector, 50))
        assert [worker.status().rows for worker in workers] == [16, 16]

    def test_worker_that_may_not_write_waits_for_the_one_that_does(
        self, places: SmallMap, worker: MilvusWorker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        places.add(unit_rows(1, 5))
        monkeypatch.setattr(milvus_module, "try_lock", lambda *_: contextlib.nullcontext(False))
        assert worker._sync_generation(places.generation_id, None)
        assert collections(worker) == []
        monkeypatch.undo()
        complete(worker)
        assert len(collections(worker)) == 1

    def test_answers_of_an_approximate_index_say_so_and_its_recall_is_measured(
        self,
        places: SmallMap,
        catalog: Catalog,
        store: FolderStore,
        on_milvus: Settings,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(milvus_module, "CHECK_SECONDS", 0.0)
        approximate = on_milvus.model_copy(update={"milvus_index": "HNSW"})
        worker = MilvusWorker(catalog, store, approximate, max_wait_seconds=60)
        places.add(unit_rows(1, 300))
        vector = unit_rows(2, 1)[0]
        response = worker.search(places.request(places.query(vector), k=10))
        assert response.certificate == "approximate"
        exact = places.brute_force(vector, 10)
        assert len({hit.photo_id for hit in response.hits} & {id_ for id_, _ in exact}) >= 5
        worker.sync()
        assert 0.5 <= worker.status().recalls[places.generation_id] <= 1


@whatever_the_catalog
class TestSearchOnMilvus(MilvusContract, SearchPortContract):
    """All promises where the rows are in an engine."""


@whatever_the_catalog
def test_milvus_without_an_address_is_refused(
    catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    with pytest.raises(Misconfigured, match="needs MILVUS_URI"):
        SearchWorker.from_settings(
            catalog, store, settings.model_copy(update={"search_engine": "milvus"})
        )


VECTOR = np.eye(1, 4, dtype=np.float32)[0]


def found_by(worker: MilvusWorker, condition: str, circle: Circle | None) -> set[UUID]:
    collection = Collection(worker.client, collection_of(worker))
    collection.delete(["~nothing"])
    hits = collection.search(VECTOR, 50, condition)
    return worker._in_circle(hits, circle)


@whatever_the_catalog
@how(
    max_examples=40,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=some.data(), count=some.integers(1, 8))
def test_expression_selects_the_photos_that_match_the_filter(
    worker: MilvusWorker, data: some.DataObject, count: int
) -> None:
    """As the mask of the scan and SQL do, by the same reference."""
    if not collections(worker):
        Collection(worker.client, "placewise_filters_FLAT").create(4, 1)
    photos = [data.draw(photo_facts(photo_id)) for photo_id in IDS[:count]]
    photo_filter = data.draw(photo_filters(photos))
    excluded = set(data.draw(some.lists(some.sampled_from(IDS), max_size=2)))
    filters = Collection(worker.client, "placewise_filters_FLAT")
    filters.delete([photo_id.hex for photo_id in IDS])
    write(worker, photos, VECTOR)
    tags = sorted({tag for photo in photos for tag in photo.tags})
    condition = filter_expression(
        photo_filter, excluded, lambda part: [tag for tag in tags if is_part_of_tag(part, tag)]
    )
    found = found_by(worker, condition, photo_filter.near)
    for photo in photos:
        expected = passes(photo, photo_filter)
        if expected is not None:
            findable = photo.role == PhotoRole.DATABASE and photo.photo_id not in excluded
            assert (photo.photo_id in found) == (expected and findable), (photo, condition)


@whatever_the_catalog
def test_levels_of_place_labels_have_no_wildcards(worker: MilvusWorker) -> None:
    Collection(worker.client, "placewise_levels_FLAT").create(4, 1)
    for level in ("a", "a%", 'a"b', "a_", "ä/b\\", "a/b"):
        labels = [level, f"{level}/x", f"{level}x", f"{level}0", "aXb/x", "", level.upper(), "ä"]
        write(worker, [facts_of(IDS[n], place=label) for n, label in enumerate(labels)], VECTOR)
        condition = filter_expression(PhotoFilter(place_under=level), (), lambda part: [])
        assert found_by(worker, condition, None) == {IDS[0], IDS[1]}, level
