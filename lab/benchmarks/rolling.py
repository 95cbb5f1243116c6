"""Rolling restart under load: every process is stopped with SIGTERM and started again, in turn.

    placewise bench rolling

Two gateways, extractors, search workers and stewards run under uploads, queries and reads. The
client behaves as one of two gateways: if one does not respond, it tries the other once, and it
waits once for the time of a `Retry-After`. Reported: requests, retries, failed requests, lost jobs,
and the longest stop of a process.
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

from lab.benchmarks.fleet import Fleet, Servers, start_servers
from lab.benchmarks.fleet.load_generator import (
    CONTENT_TYPE,
    HttpCaller,
    HttpResponse,
    make_jpegs,
    multipart_form,
    wait_for_jobs,
)
from lab.benchmarks.report import Report
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


class _LoadClients:
    """Threads that send requests to two gateways and record failed ones."""

    def __init__(self, urls: Sequence[str], photos: Sequence[bytes]) -> None:
        self._callers = [HttpCaller(url) for url in urls]
        self._photos = photos
        self._stop = threading.Event()
        self.uploaded: list[tuple[str, str]] = []
        """(photo, job) of each upload that was acknowledged."""
        self.findable: list[str] = []
        """Photos whose job has been seen to succeed."""
        self.requests: Counter[str] = Counter()
        self.retries: Counter[str] = Counter()
        """Retries by request and reason."""
        self.failed: list[str] = []
        loops = (self._upload, self._query_new_photo, self._query_stored_photo, self._read)
        self._threads = [threading.Thread(target=self._run, args=(loop,)) for loop in loops]

    def begin(self, photos: int) -> None:
        """Upload the first photos, so that queries have results."""
        for _ in range(photos):
            self._upload()
        for photo_id, job_id in list(self.uploaded):
            self._call("job", "GET", f"/api/v1/jobs/{job_id}?wait=30")
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

    def _run(self, request: Callable[[], None]) -> None:
        while not self._stop.wait(PAUSE_SECONDS):
            request()

    def _upload(self) -> None:
        form = multipart_form(random.choice(self._photos))
        answer = self._call("upload", "POST", "/api/v1/upload", form, **CONTENT_TYPE)
        if answer is not None:
            self.uploaded.append((answer.json()["file_id"], answer.json()["job_id"]))

    def _query_new_photo(self) -> None:
        name, form = "query by new photo", multipart_form(random.choice(self._photos))
        path, headers = "/api/v1/similarity?top_k=3", {"Prefer": "wait=30", **CONTENT_TYPE}
        answer = self._call(name, "POST", path, form, **headers)
        if answer is not None and answer.status == 202:
            # A gateway that stops does not wait for the result.
            self._call("job", "GET", f"{answer.json()['status_url']}?wait=30")
            answer = self._call("result", "GET", answer.json()["result_url"])
        self._check_complete(name, answer)

    def _query_stored_photo(self) -> None:
        path = f"/api/v1/similarity/{random.choice(self.findable)}?top_k=3"
        name = "query by stored photo"
        self._check_complete(name, self._call(name, "POST", path))

    def _check_complete(self, name: str, answer: HttpResponse | None) -> None:
        if answer is not None and answer.json()["missing"]:
            self.failed.append(f"{name}: {answer.body!r}")

    def _read(self) -> None:
        photo_id, job_id = random.choice(self.uploaded)
        path = random.choice(
            (
                f"uploads/{photo_id}",
                f"uploads/{photo_id}/image",
                f"jobs/{job_id}",
                "search?limit=5",
                "database/stats",
            )
        )
        self._call("read", "GET", f"/api/v1/{path}")

    def _call(
        self, what: str, method: str, path: str, body: bytes | None = None, **headers: str
    ) -> HttpResponse | None:
        """Return the response; record a failure and return None if the retries fail too."""
        self.requests[what] += 1
        gateway, can_switch, can_wait = random.randrange(2), True, True
        while True:
            try:
                answer = self._callers[gateway].call(method, path, body, **headers)
            except (OSError, HTTPException) as error:
                reason = f"{type(error).__name__}: {error}"
                if can_switch:
                    gateway, can_switch = 1 - gateway, False
                    self.retries[f"{what}: {type(error).__name__}"] += 1
                    continue
            else:
                if answer.status < 300:
                    return answer
                reason = f"{answer.status} {answer.body!r}"
                pause = answer.headers.get("Retry-After")
                if pause is not None and can_wait:
                    can_wait = False
                    self.retries[f"{what}: {answer.status}, Retry-After {pause}"] += 1
                    time.sleep(float(pause))
                    continue
            self.failed.append(f"{what}: {method} {path}: {reason}")
            return None


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
        clients = _LoadClients(fleet.gateway_urls, make_jpegs(TEXTURES, (320, 240), 20_000))
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
        crashed = list(fleet.crashed)
    for what, count in clients.requests.items():
        report.add(f"requests: {what}", count)
    for why, count in clients.retries.items():
        report.add(f"retried: {why}", count)
    report.add("requests failed", len(clients.failed), at_most=0)
    report.add("jobs lost", lost, at_most=0)
    report.add(
        "services with another exit code than 0",
        sum(code != 0 for code in codes.values()),
        at_most=0,
    )
    report.add("services that crashed", len(crashed), at_most=0)
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
