"""The HTTP API in this process, on the test's catalog: what e2e tests can't do on PostgreSQL."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import httpx2
from starlette.testclient import TestClient

from services.extractor.worker import ExtractorWorker
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.worker import SearchWorker
from services.steward.tasks.model_changes import advance_model_changes
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups
from shared.storage import OwnedStore
from tests.integration.api_with_keys import make_app
from tests.support.photos import photo_bytes

API = "/api/v1"


class Service:
    """A gateway with its search worker; `drain` does what an extractor does meanwhile."""

    def __init__(
        self,
        catalog: Catalog,
        store: OwnedStore,
        settings: Settings,
        make_worker: Callable[[], ExtractorWorker],
    ) -> None:
        self.catalog, self.store, self.settings = catalog, store, settings
        self.search = SearchWorker(catalog, store, settings)
        self.wakeups = InProcessWakeups()
        gateway = GatewayContext(
            catalog, store, self.wakeups, self.search, settings, LocalhostAuthenticator()
        )
        self._client = TestClient(make_app(gateway), base_url="http://localhost")
        self.make_worker = make_worker
        self._worker: ExtractorWorker | None = None

    @property
    def worker(self) -> ExtractorWorker:
        if self._worker is None:
            self._worker = self.make_worker()
        return self._worker

    def __call__(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """`METHOD /api/v1PATH`."""
        return self._client.request(method, f"{API}{path}", **options)

    def json(self, method: str, path: str, status: int = 200, **options: Any) -> Any:
        answer = self(method, path, **options)
        assert answer.status_code == status, answer.text
        return answer.json()

    def upload(self, data: bytes, map_name: str = "default", **fields: Any) -> Any:
        """A photo that was acknowledged and is not described yet."""
        return self.json(
            "POST",
            "/upload",
            202,
            params={"map": map_name},
            files={"file": ("photo.jpg", data)},
            data={name: str(value) for name, value in fields.items()},
        )

    def indexed(self, *numbers: int, map_name: str = "default", **fields: Any) -> list[str]:
        """Photos that can be found; their ids."""
        found = [
            self.upload(photo_bytes(number), map_name, **fields)["file_id"] for number in numbers
        ]
        self.drain()
        return found

    def ask(self, data: bytes, map_name: str = "default", **params: Any) -> str:
        """A query with a new photo; its job."""
        files = {"file": ("query.jpg", data)}
        params = {"map": map_name, **params}
        started = self.json("POST", "/similarity", 202, params=params, files=files)
        return str(started["job_id"])

    def ended(self, job_id: str, map_name: str = "default") -> Any:
        """The job once extractor and steward have ended it."""
        for _ in range(60):
            self.drain()
            advance_model_changes(self.catalog, self.wakeups)
            job = self.json("GET", f"/jobs/{job_id}", params={"map": map_name})
            if job["state"] not in ("queued", "running"):
                return job
        raise AssertionError(f"the job did not end: {job}")

    def done(self, started: httpx2.Response, map_name: str = "default") -> Any:
        """The result of the job that the answer names."""
        assert started.status_code == 202, started.text
        job = self.ended(started.json()["job_id"], map_name)
        assert job["state"] == "succeeded", job
        return job["result"]

    def drain(self) -> None:
        stop = threading.Event()
        self.worker.drain(stop)
        while self.worker.fits.run_next(stop):
            self.worker.drain(stop)
