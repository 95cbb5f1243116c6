"""PostgreSQL killed, silent or too busy: a 503 within seconds, no part dies, nothing is lost."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx2
import pytest
from sqlalchemy import func, select
from starlette.testclient import TestClient

from services.extractor.worker import ExtractorWorker
from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.worker import SearchWorker
from services.service_process import start_service_threads
from services.steward.evaluation_worker import EvaluationWorker
from services.steward.scheduler import Scheduler
from shared.catalog.chunks import Descriptor, find_descriptor
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog, PoolConfig, TransactionTimeouts
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map, get_or_create_default_map
from shared.catalog.photos import Photo
from shared.catalog.processes import process_heartbeat
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups
from shared.search_api.protocol import SearchRequest
from shared.storage import FolderStore
from tests.support.photos import photo_bytes
from tests.support.servers import PostgresServer, start_postgres
from tests.support.waiting import wait_until

API = "/api/v1"
STATEMENT_SECONDS = 2.0
# A statement, a ping or a connection that is given up, on a busy machine.
ANSWER_SECONDS = 20.0
RECOVERY_SECONDS = 60.0
UPLOADERS = 3
WAITING_PARTS = ("steward", "worker extractor", "worker evaluator")


@pytest.fixture(scope="module")
def breakable() -> Iterator[PostgresServer]:
    """A server of this module's own."""
    with start_postgres(own=True) as server:
        yield server


class Deployment:
    """Every service's parts in this process, on one PostgreSQL."""

    def __init__(self, url: str, folder: Path) -> None:
        settings = Settings().model_copy(
            update={"lease_seconds": 3.0, "device": "cpu", "decode_processes": 1}
        )
        self.catalog = Catalog(
            url, PoolConfig(size=4, overflow=4, wait_seconds=1.0, connect_seconds=2.0)
        )
        migrate(self.catalog)
        with self.catalog.write() as session:
            get_or_create_default_map(session, settings.new_map_extractor)
        store, wakeups = FolderStore(folder / "objects"), InProcessWakeups()
        self.search = SearchWorker(self.catalog, store, settings)
        self._extractor = ExtractorWorker(self.catalog, store, settings, "extractor")
        self.requests = self.catalog.with_timeouts(
            TransactionTimeouts(STATEMENT_SECONDS, lock_seconds=1.0)
        )
        gateway = GatewayContext(
            self.requests, store, wakeups, self.search, settings, LocalhostAuthenticator()
        )
        self.client = TestClient(
            create_app(gateway), base_url="http://localhost", raise_server_exceptions=False
        )
        evaluator = EvaluationWorker(self.catalog, store, self.search, settings, "evaluator")
        self._heartbeat = contextlib.ExitStack()
        self._heartbeat.enter_context(process_heartbeat(self.catalog, "search", self.search.state))
        self._stop = threading.Event()
        self._parts = start_service_threads(
            {
                "search": self.search.run,
                "extractor": partial(self._extractor.run, wait=wakeups.wait),
                "steward": Scheduler(self.catalog, store, wakeups, settings).run,
                "evaluator": evaluator.run,
            },
            self._stop,
        )

    def is_complete(self) -> bool:
        return all(part.is_alive() for part in self._parts)

    def call(self, method: str, path: str, **options: Any) -> httpx2.Response:
        begun = time.monotonic()
        answer = self.client.request(method, path, **options)
        took = time.monotonic() - begun
        assert took < ANSWER_SECONDS, f"{method} {path} took {took:.1f} s"
        if answer.status_code == 503 and path not in ("/readyz", f"{API}/health"):
            assert answer.headers["retry-after"], answer.text
            assert answer.json()["code"] in ("catalog_unavailable", "catalog_busy"), answer.text
        return answer

    def upload(self, number: int) -> httpx2.Response:
        files = {"file": (f"{number}.jpg", photo_bytes(number))}
        return self.call("POST", f"{API}/upload", files=files)

    def searchable(self) -> int:
        with self.catalog.read() as session:
            return session.scalar(select(func.count()).select_from(Descriptor)) or 0

    def wait_for(self, searchable: int) -> None:
        wait_until(lambda: self.searchable() >= searchable, RECOVERY_SECONDS)
        assert self.searchable() == searchable

    def request(self, photo_id: str) -> SearchRequest:
        """What the gateway asks the search tier for a stored photo."""
        with self.catalog.read() as session:
            map_ = get_map(session, "default")
            generation = active_generation(session, map_.id)
            assert generation is not None
            found = find_descriptor(session, generation.id, session.get_one(Photo, photo_id).id)
            assert found is not None
            return SearchRequest(
                generation_id=generation.id,
                object_key=found[1].object_key,
                row=found[0].row,
                min_version=map_.version,
                k=3,
            )

    def close(self) -> None:
        self._stop.set()
        for part in self._parts:
            part.join()
        self._heartbeat.close()
        self._extractor.close()
        self.catalog.close()


@pytest.fixture
def deployment(breakable: PostgresServer, tmp_path: Path) -> Iterator[Deployment]:
    made = Deployment(breakable.new_database(), tmp_path)
    try:
        yield made
    finally:
        made.close()


def test_catalog_killed_under_uploads_loses_nothing_that_was_acknowledged(
    deployment: Deployment, breakable: PostgresServer, caplog: pytest.LogCaptureFixture
) -> None:
    assert breakable.process is not None
    first = deployment.upload(0).json()["file_id"]
    deployment.wait_for(1)
    request = deployment.request(first)
    deployment.search.sync()
    acknowledged, refused, strange = {first}, threading.Event(), []
    stop = threading.Event()

    def waits(part: str) -> list[str]:
        return [r.message for r in caplog.records if f"the {part} waits" in r.message]

    def upload(numbers: Iterator[int]) -> None:
        for number in numbers:
            while not stop.is_set():
                answer = deployment.upload(number)
                if answer.status_code in (200, 202):
                    acknowledged.add(answer.json()["file_id"])
                    break
                if answer.status_code != 503:
                    strange.append(answer.text)
                    return
                refused.set()
                time.sleep(0.1)

    uploaders = [
        threading.Thread(target=upload, args=(iter(range(1 + n, 31, UPLOADERS)),))
        for n in range(UPLOADERS)
    ]
    for uploader in uploaders:
        uploader.start()
    wait_until(lambda: len(acknowledged) >= 8)
    breakable.process.kill()
    try:
        assert refused.wait(ANSWER_SECONDS)
        assert deployment.call("GET", "/livez").status_code == 200
        assert deployment.call("GET", "/readyz").status_code == 503
        assert deployment.call("GET", f"{API}/search").status_code == 503
        parts = deployment.call("GET", f"{API}/health")
        assert (parts.status_code, parts.json()["parts"]["catalog"]["status"]) == (503, "unhealthy")
        assert deployment.search.search(request).hits, "search answers from memory"
        wait_until(lambda: all(waits(part) for part in WAITING_PARTS), ANSWER_SECONDS)
        time.sleep(3.0)  # every loop meets it several times
    finally:
        breakable.process.start()
    for uploader in uploaders:
        uploader.join(RECOVERY_SECONDS)
    stop.set()
    assert not strange
    assert len(acknowledged) == 31
    deployment.wait_for(31)
    assert deployment.call("GET", "/readyz").status_code == 200
    assert deployment.is_complete(), "a part ended"
    for part in WAITING_PARTS:
        # Once per outage, and again where what had begun before it succeeded in it.
        assert 1 <= len(waits(part)) <= 2, waits(part)


def test_silent_catalog_is_given_up_within_seconds(
    deployment: Deployment, breakable: PostgresServer
) -> None:
    assert breakable.process is not None
    assert deployment.call("GET", f"{API}/search").status_code == 200
    breakable.process.pause()
    try:
        assert deployment.call("GET", f"{API}/search").status_code == 503
        assert deployment.call("GET", "/readyz").status_code == 503
        assert deployment.call("GET", "/livez").status_code == 200
    finally:
        breakable.process.resume()
    wait_until(lambda: deployment.call("GET", "/readyz").is_success, RECOVERY_SECONDS)
    assert deployment.call("GET", f"{API}/search").status_code == 200
    assert deployment.is_complete()
