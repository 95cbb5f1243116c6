"""A real Milvus: it answers as milvus-lite does, and while it is killed, emptied and paused."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from uuid import UUID

import numpy as np
import pytest
from pydantic import SecretStr

from services.search.milvus import worker as milvus_module
from services.search.milvus.worker import MilvusWorker
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage import FolderStore
from tests.contract.search import test_milvus as lite
from tests.contract.search.test_milvus import collections, on_milvus, port, worker
from tests.contract.search.test_search_backend import whatever_the_catalog
from tests.support.servers import MilvusServer, start_milvus
from tests.support.small_map import SmallMap, assert_answers, unit_rows
from tests.support.waiting import wait_until

__all__ = ["on_milvus", "port", "worker"]
pytestmark = pytest.mark.databases("postgresql")
BACK_SECONDS = 120.0  # for a server that was started again to have loaded its collections
VECTOR = unit_rows(1000, 1)[0]


@pytest.fixture(scope="module")
def server() -> Iterator[MilvusServer]:
    """One of its own, to be killed."""
    with start_milvus() as started:
        yield started


@pytest.fixture
def milvus_uri(server: MilvusServer) -> str:
    return server.url


@whatever_the_catalog
class TestSearchOnAMilvusServer(lite.MilvusContract):
    """The same promises of a server."""

    @pytest.fixture(autouse=True)
    def _no_collections(self, worker: MilvusWorker) -> Iterator[None]:
        yield
        for name in collections(worker):
            worker.client.drop_collection(name)

    test_expressions = staticmethod(lite.test_expression_selects_the_photos_that_match_the_filter)
    test_levels = staticmethod(lite.test_levels_of_place_labels_have_no_wildcards)


class Load:
    """Workers that follow the catalog, and threads that ask them all the time."""

    def __init__(self, places: SmallMap, settings: Settings, server: MilvusServer) -> None:
        self.server = server
        self.places = places
        self.workers = [
            MilvusWorker(places.catalog, places.store, settings, max_wait_seconds=2.0)
            for _ in range(2)
        ]
        self.reference = places.query(VECTOR)
        self.answers: list[SearchResponse] = []
        self.found: dict[int, dict[UUID, float]] = {}
        self.note()
        self.refusals: list[str] = []
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=target, args=(worker,))
            for worker in self.workers
            for target in (self._follow, self._ask)
        ]

    def _follow(self, worker: MilvusWorker) -> None:
        worker.run(self._stop)

    def _ask(self, worker: MilvusWorker) -> None:
        while not self._stop.is_set():
            try:
                self.answers.append(worker.search(self.request()))
            except Unavailable as error:
                self.refusals.append(error.code)
            time.sleep(0.05)

    def request(self) -> SearchRequest:
        return self.places.request(self.reference, k=100, min_version=0)

    def __enter__(self) -> Load:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def note(self) -> None:
        """Remember what a search finds at the current version."""
        self.found[self.places.version] = dict(self.places.brute_force(VECTOR, 100))

    def check(self) -> None:
        """No answer lacks a photo that was there all the time, unless it says so."""
        assert self.answers
        for answer in self.answers:
            found = {hit.photo_id: hit.score for hit in answer.hits}
            later = [self.found[v] for v in self.found if v >= answer.snapshot_version]
            always = set.intersection(*map(set, later)) if not answer.missing else set()
            known = {
                photo_id: score for one in self.found.values() for photo_id, score in one.items()
            }
            assert always <= found.keys() <= known.keys()
            assert found == pytest.approx({photo_id: known[photo_id] for photo_id in found})
            assert answer.certificate == ("none" if answer.missing else "exhaustive")
        assert set(self.refusals) <= {"engine_unavailable", "search_behind"}

    def wait_until_whole(self) -> None:
        """Until both workers answer with everything again."""
        deadline = time.monotonic() + BACK_SECONDS
        for each in self.workers:
            while True:
                with contextlib.suppress(Unavailable):
                    answer = each.search(self.places.request(self.reference, k=100))
                    if not answer.missing:
                        assert_answers(answer, self.places.brute_force(VECTOR, 100))
                        break
                assert time.monotonic() < deadline, self.refusals[-3:]
                self.server.supervise()
                time.sleep(0.1)


@pytest.fixture
def load(
    catalog: Catalog, store: FolderStore, settings: Settings, server: MilvusServer
) -> Iterator[Load]:
    places = SmallMap(catalog, store)
    for seed in range(4):
        places.add(unit_rows(seed, 10))
    update = {"search_engine": "milvus", "milvus_uri": SecretStr(server.url)}
    with Load(places, settings.model_copy(update=update), server) as running:
        running.wait_until_whole()
        yield running


def test_answers_are_whole_or_refused_while_milvus_is_killed_and_started_again(
    load: Load, server: MilvusServer
) -> None:
    server.process.kill()
    wait_until(lambda: "engine_unavailable" in load.refusals)
    server.process.start()
    load.wait_until_whole()
    load.check()


def test_rows_are_written_again_after_milvus_has_lost_its_folder(
    load: Load, server: MilvusServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(milvus_module, "STEP_SECONDS", 0.0)
    server.lose_everything()
    load.wait_until_whole()
    load.check()
    assert any(answer.missing for answer in load.answers), "what was missing was never named"


def test_calls_end_while_milvus_stands_still_and_go_on_afterwards(
    load: Load, server: MilvusServer
) -> None:
    server.process.pause()
    begun = time.monotonic()
    try:
        with pytest.raises(Unavailable):
            load.workers[0].search(load.request())
        assert time.monotonic() - begun < 30, "two calls of READ_SECONDS, on a busy machine"
        time.sleep(60)
    finally:
        server.process.resume()
    load.wait_until_whole()
    load.check()


def test_photos_come_and_go_while_a_collection_is_dropped_and_milvus_is_killed(
    load: Load, server: MilvusServer
) -> None:
    places, client = load.places, load.workers[0].client
    for seed in range(20, 26):
        rows = VECTOR + unit_rows(seed, 2) / 10
        photo_ids = places.add(rows / np.linalg.norm(rows, axis=1, keepdims=True))
        load.note()
        places.delete(photo_ids[0])
        load.note()
        if seed == 22:
            for name in client.list_collections():
                client.drop_collection(name)
        if seed == 24:
            load.wait_until_whole()  # killed in a creation, this release does not always recover
            server.process.kill()
            server.process.start()
        places.merge()
    load.wait_until_whole()
    places.delete(photo_ids[1])
    load.note()
    load.wait_until_whole()
    load.check()
