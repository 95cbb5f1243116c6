"""Answers while Milvus is killed, emptied and paused: none is wrong without a word."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import pytest
from pydantic import SecretStr

from services.search.milvus import index as index_module
from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage import FolderStore
from tests.support.servers import MilvusServer, start_milvus
from tests.support.small_map import SmallMap, assert_answers, unit_rows

pytestmark = pytest.mark.databases("postgresql")
BACK_SECONDS = 120.0  # for a server that was started again to have loaded its collections
VECTOR = unit_rows(1000, 1)[0]


@pytest.fixture(scope="module")
def server() -> Iterator[MilvusServer]:
    """One of its own, to be killed."""
    with start_milvus() as started:
        yield started


class Load:
    """Workers that follow the catalog, and threads that ask them without a pause."""

    def __init__(self, places: SmallMap, settings: Settings, server: MilvusServer) -> None:
        self.server = server
        self.places = places
        self.workers = [
            SearchWorker(places.catalog, places.store, settings, max_wait_seconds=2.0)
            for _ in range(2)
        ]
        self.reference = places.query(VECTOR)
        self.answers: list[tuple[float, SearchResponse]] = []
        self.refusals: list[str] = []
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=target, args=(worker,))
            for worker in self.workers
            for target in (self._follow, self._ask)
        ]

    def _follow(self, worker: SearchWorker) -> None:
        worker.run(self._stop)

    def _ask(self, worker: SearchWorker) -> None:
        while not self._stop.is_set():
            begun = time.monotonic()
            try:
                self.answers.append((begun, worker.search(self.request())))
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

    def check(self) -> None:
        """Each answer is whole, or says that it is not."""
        whole = self.places.brute_force(VECTOR, 100)
        assert self.answers
        for _, answer in self.answers:
            if answer.missing:
                assert answer.certificate == "none"
                assert {hit.photo_id for hit in answer.hits} <= {photo_id for photo_id, _ in whole}
            else:
                assert_answers(answer, whole)
        assert set(self.refusals) <= {"engine_unavailable", "search_behind"}

    def wait_until_whole(self) -> None:
        """Until both workers answer with everything again."""
        deadline = time.monotonic() + BACK_SECONDS
        for worker in self.workers:
            while True:
                with contextlib.suppress(Unavailable):
                    answer = worker.search(self.places.request(self.reference, k=100))
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
    time.sleep(2)
    server.process.start()
    load.wait_until_whole()
    load.check()
    assert "engine_unavailable" in load.refusals


def test_rows_are_written_again_after_milvus_has_lost_its_folder(
    load: Load, server: MilvusServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "STEP_SECONDS", 0.0)
    server.lose_everything()
    load.wait_until_whole()
    load.check()
    assert any(answer.missing for _, answer in load.answers), "what was missing was never named"


def test_calls_end_while_milvus_stands_still_and_go_on_afterwards(
    load: Load, server: MilvusServer
) -> None:
    server.process.pause()
    begun = time.monotonic()
    try:
        with pytest.raises(Unavailable):
            load.workers[0].search(load.request())
        assert time.monotonic() - begun < 9
        time.sleep(60)
    finally:
        server.process.resume()
    load.wait_until_whole()
    load.check()
