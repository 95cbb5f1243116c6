"""Benchmark of a rolling restart under load: every process is restarted, one after the other.

Each gateway, extractor, search worker and steward is stopped with SIGTERM and started again, under
uploads, queries and reads. The client behaves as one of two gateways: if one does not respond, it
tries the other once, and it waits once for the time of a `Retry-After`.
"""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from sqlalchemy import select

from benchmarks.fleet import Fleet, Servers, start_servers
from benchmarks.load_generator import (
    CONTENT_TYPE,
    HttpCaller,
    HttpResponse,
    make_jpegs,
    multipart_form,
    wait_for_jobs,
)
from benchmarks.report import Report
from shared.catalog.chunks import Descriptor

if TYPE_CHECKING:
    from rich.progress import Progress

ALL_SERVICES = (
    *("gateway-0", "gateway-1", "extractor-0", "extractor-1"),
    *("search-0-0", "search-0-1", "steward-0", "steward-1"),
)
PAUSE_SECONDS = 0.1  # between a client's requests, so that the CPU is not saturated
TIMEOUT_SECONDS = 120.0
BATCH = 4
TEXTURES = 16
INITIAL_PHOTOS = 12


class LoadClients:
    """Threads that send requests to two gateways and record failed ones."""

    def __init__(self, urls: Sequence[str], photos: Sequence[bytes]) -> None:
        self._callers = [HttpCaller(url) for url in urls]
        self._photos = photos
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self.uploaded: list[tuple[str, str]] = []
        """(photo, job) of each upload that was acknowledged."""
        self.findable: list[str] = []
        """Photos whose job has been seen to succeed."""
        self.requests: Counter[str] = Counter()
        self.again: Counter[str] = Counter()
        """What was tried a second time, and why."""
        self.failed: list[str] = []
        works: list[Callable[[random.Random], None]] = [
            *(self._upload, self._query_new_photo, self._query_stored_photo, self._read),
        ]
        self._threads = [
            threading.Thread(target=self._run, args=(work, number), name=work.__name__)
            for number, work in enumerate(works)
        ]

    def begin(self, photos: int) -> None:
        """Upload the first photos, so that queries have results."""
        chance = random.Random(-1)
        for _ in range(photos):
            self._upload(chance)
        for photo_id, job_id in list(self.uploaded):
            self._call(0, "job", "GET", f"/api/v1/jobs/{job_id}?wait=30")
            self.findable.append(photo_id)
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        for caller in self._callers:
            caller.close()

    def _run(self, work: Callable[[random.Random], None], number: int) -> None:
        chance = random.Random(number)
        while not self._stop.wait(PAUSE_SECONDS):
            work(chance)

    def _upload(self, chance: random.Random) -> None:
        form = multipart_form(chance.choice(self._photos))
        answer = self._call(
            chance.randrange(2), "upload", "POST", "/api/v1/upload", form, **CONTENT_TYPE
        )
        if answer is not None:
            body = answer.json()
            self.uploaded.append((body["file_id"], body["job_id"]))

    def _query_new_photo(self, chance: random.Random) -> None:
        form = multipart_form(chance.choice(self._photos))
        answer = self._call(
            chance.randrange(2),
            "query by new photo",
            "POST",
            "/api/v1/similarity?top_k=3",
            form,
            Prefer="wait=30",
            **CONTENT_TYPE,
        )
        if answer is not None and answer.status == 202:
            # A gateway that stops answers so, sooner than it was asked to.
            body = answer.json()
            self._call(chance.randrange(2), "job", "GET", f"{body['status_url']}?wait=30")
            answer = self._call(chance.randrange(2), "result", "GET", body["result_url"])
        if answer is not None and answer.json()["missing"]:
            self._record_failure(f"query by new photo: {answer.body!r}")

    def _query_stored_photo(self, chance: random.Random) -> None:
        photo_id = chance.choice(self.findable)
        answer = self._call(
            chance.randrange(2),
            "query by stored photo",
            "POST",
            f"/api/v1/similarity/{photo_id}?top_k=3",
        )
        if answer is not None and answer.json()["missing"]:
            self._record_failure(f"query by stored photo: {answer.body!r}")

    def _read(self, chance: random.Random) -> None:
        photo_id, job_id = chance.choice(self.uploaded)
        path = chance.choice(
            (
                f"/api/v1/uploads/{photo_id}",
                f"/api/v1/uploads/{photo_id}/image",
                f"/api/v1/jobs/{job_id}",
                "/api/v1/search?limit=5",
                "/api/v1/database/stats",
            )
        )
        self._call(chance.randrange(2), "read", "GET", path)

    def _call(
        self, first: int, what: str, method: str, path: str, body: bytes | None = None, **head: str
    ) -> HttpResponse | None:
        """Return the response; record a failure and return None if the retry fails too."""
        self.requests[what] += 1
        at, other_left, wait_left = first, True, True
        while True:
            why = ""
            try:
                answer = self._callers[at].call(method, path, body, **head)
            except (OSError, HTTPException) as error:
                why = f"{type(error).__name__}: {error}"
                if other_left:
                    at, other_left = 1 - at, False
                    self.again[f"{what}: {type(error).__name__}"] += 1
                    continue
            else:
                if answer.status < 300:
                    return answer
                why = f"{answer.status} {answer.body!r}"
                pause = answer.headers.get("Retry-After")
                if pause is not None and wait_left:
                    wait_left = False
                    self.again[f"{what}: {answer.status}, Retry-After {pause}"] += 1
                    time.sleep(float(pause))
                    continue
            self._record_failure(f"{what}: {method} {path}: {why}")
            return None

    def _record_failure(self, reason: str) -> None:
        with self._lock:
            self.failed.append(reason)


def measure(progress: Progress) -> Report:
    """Restart every process once."""
    with tempfile.TemporaryDirectory() as folder, start_servers() as servers:
        bar = progress.add_task("restarting", total=len(ALL_SERVICES))
        return restart_under_load(
            Path(folder), servers, ALL_SERVICES, lambda: progress.advance(bar)
        )


def restart_under_load(
    folder: Path,
    servers: Servers,
    names: Sequence[str],
    on_restarted: Callable[[], object] = lambda: None,
    *,
    executed: bool = True,
) -> Report:
    """Restart the named services, two processes each, one by one. `executed`: see `Fleet`."""
    report = Report("Rolling restart under load")
    with Fleet(
        folder,
        servers,
        gateways=2,
        extractors=2,
        replicas=2,
        stewards=2,
        executed=executed,
        extractor="test-slow-avg:milliseconds=20,width=1024",
        batch_photos=BATCH,
    ) as fleet:
        fleet.start()
        clients = LoadClients(fleet.gateway_urls, make_jpegs(TEXTURES, (320, 240), 20_000))
        codes: dict[str, int] = {}
        stopping: dict[str, float] = {}
        try:
            clients.begin(INITIAL_PHOTOS)
            for name in names:
                started_at = time.monotonic()
                codes[name] = fleet[name].stop()
                stopping[name] = time.monotonic() - started_at
                fleet.start(name)
                on_restarted()
        finally:
            clients.end()
        wait_for_jobs(fleet.catalog, TIMEOUT_SECONDS)
        lost = _count_undescribed(fleet, [UUID(photo_id) for photo_id, _ in clients.uploaded])
        logs = fleet.logs()
        fell = list(fleet.crashed)
    for what, count in clients.requests.items():
        report.add(f"requests: {what}", count)
    for why, count in clients.again.items():
        report.add(f"tried again: {why}", count)
    report.add("requests failed", len(clients.failed), at_most=0)
    report.add("jobs lost", lost, at_most=0)
    report.add("services that ended badly", sum(code != 0 for code in codes.values()), at_most=0)
    report.add("services that fell", len(fell), at_most=0)
    report.add("longest stop", max(stopping.values()), "s")
    report.details = {
        "failed": clients.failed,
        "exit_codes": codes,
        "stop_seconds": stopping,
        "logs": logs if clients.failed else "",
    }
    return report


def _count_undescribed(fleet: Fleet, acknowledged: Sequence[UUID]) -> int:
    with fleet.catalog.read() as session:
        found = set(session.scalars(select(Descriptor.photo_id)))
    return len(set(acknowledged) - found)
