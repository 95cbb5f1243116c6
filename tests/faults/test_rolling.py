"""A rolling restart under load: no request that a reasonable client makes fails, no job is lost."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any
from uuid import UUID

import httpx2
import pytest
from sqlalchemy import select

from shared.catalog.chunks import Descriptor
from tests.support.fleet import open_fleet
from tests.support.invariants import count_unfinished_jobs
from tests.support.photos import photo_bytes
from tests.support.server import SERVICES_KEY
from tests.support.waiting import wait_until

ONE_OF_EACH = ("gateway-0", "extractor-0", "search-0", "steward-0")
FIRST_PHOTOS = 12
PAUSE_SECONDS = 0.1  # between a client's requests, so that the CPU is not saturated


class Clients:
    """Threads that upload, search and read at two gateways.

    If one gateway does not answer, they try the other once, and they wait once for `Retry-After`.
    """

    def __init__(self, urls: Sequence[str]) -> None:
        headers = {"Authorization": f"Bearer {SERVICES_KEY}"}
        self._gateways = [
            httpx2.Client(base_url=f"{url}/api/v1", headers=headers, timeout=60) for url in urls
        ]
        self._stop = threading.Event()
        self._numbers = iter(range(1_000_000))
        self.uploaded: list[str] = []
        self.findable: list[str] = []
        """Photos that a search for them must find."""
        self.answered: Counter[str] = Counter()
        self.failed: list[str] = []
        loops = (self._upload, self._search_new, self._search_stored, self._read)
        self._threads = [threading.Thread(target=self._repeat, args=(loop,)) for loop in loops]

    def start(self) -> None:
        """Upload the first photos, so that searches have results, and start the threads."""
        for _ in range(FIRST_PHOTOS):
            job = self._upload()
            self._call("GET", f"/jobs/{job['job_id']}?wait=30")
            self.findable.append(job["file_id"])
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        for gateway in self._gateways:
            gateway.close()

    def _repeat(self, request: Callable[[], object]) -> None:
        while not self._stop.wait(PAUSE_SECONDS):
            if request() is not None:
                self.answered[request.__name__] += 1

    def _upload(self) -> Any:
        answer = self._call("POST", "/upload", files=self._photo())
        if answer is not None:
            self.uploaded.append(answer["file_id"])
        return answer

    def _search_new(self) -> Any:
        prefer = {"Prefer": "wait=30"}
        answer = self._call("POST", "/similarity?top_k=3", files=self._photo(), headers=prefer)
        if answer is not None and "similar_images" not in answer:
            # A gateway that stops does not wait for the result.
            self._call("GET", f"/jobs/{answer['job_id']}?wait=30")
            answer = self._call("GET", answer["result_url"].removeprefix("/api/v1"))
        return self._complete(answer)

    def _search_stored(self) -> Any:
        photo = random.choice(self.findable)
        return self._complete(self._call("POST", f"/similarity/{photo}?top_k=3"))

    def _complete(self, answer: Any) -> Any:
        if answer is not None and answer["missing"]:
            self.failed.append(f"without {answer['missing']}")
        return answer

    def _read(self) -> Any:
        photo = random.choice(self.uploaded)
        paths = (f"/uploads/{photo}", "/search?limit=5", "/database/stats")
        return self._call("GET", random.choice(paths))

    def _photo(self) -> dict[str, Any]:
        return {"file": ("photo.jpg", photo_bytes(next(self._numbers)))}

    def _call(self, method: str, path: str, **options: Any) -> Any:
        """Return the JSON of the answer; None and a failure if the retries fail too."""
        gateway, can_switch, can_wait = random.randrange(2), True, True
        while True:
            try:
                answer = self._gateways[gateway].request(method, path, **options)
            except httpx2.TransportError as error:
                reason = repr(error)
                if can_switch:
                    gateway, can_switch = 1 - gateway, False
                    continue
            else:
                if answer.is_success:
                    return answer.json()
                reason = f"{answer.status_code} {answer.text}"
                if can_wait and "Retry-After" in answer.headers:
                    can_wait = False
                    time.sleep(float(answer.headers["Retry-After"]))
                    continue
            self.failed.append(f"{method} {path}: {reason}")
            return None


@pytest.mark.timeout(600)
def test_restarting_one_of_each_service_fails_no_request_and_loses_no_job() -> None:
    with open_fleet(
        gateways=2,
        extractors=2,
        replicas=2,
        stewards=2,
        executed=False,
        extractor="test-slow-avg:milliseconds=20,width=1024",
        batch_photos=4,
    ) as fleet:
        fleet.start()
        clients = Clients(fleet.gateway_urls)
        try:
            clients.start()
            for name in ONE_OF_EACH:
                assert fleet[name].stop() == 0, f"{name}: {fleet.logs()}"
                fleet.start(name)
        finally:
            clients.stop()
        assert not clients.failed, fleet.logs()
        assert not fleet.crashed
        assert min(clients.answered.values()) >= len(ONE_OF_EACH), clients.answered
        assert len(clients.answered) == 4, clients.answered
        wait_until(lambda: not count_unfinished_jobs(fleet.catalog))
        with fleet.catalog.read() as session:
            described = set(session.scalars(select(Descriptor.photo_id)))
        assert {UUID(photo) for photo in clients.uploaded} <= described
