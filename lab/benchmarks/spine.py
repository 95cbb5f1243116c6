"""Latency of the embedded server: upload, search by a stored photo, search by a new photo.

    placewise bench spine [--photos 200] [--queries 50]        (or: make bench)

`placewise serve` runs in a process of its own on an empty folder, with the default extractor, which
is loaded when the first photo is searchable. Then four clients upload photos of 320 x 240 pixels,
and one client searches. Reported: p50, p95 and maximum of each call, calls per second, and the time
from the first measured upload until all photos are searchable.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from lab.benchmarks.fleet.load_generator import make_jpegs
from lab.benchmarks.fleet.service import START_TIMEOUT_SECONDS, start_embedded_server
from lab.benchmarks.report import Report
from placewise.client import Client

if TYPE_CHECKING:
    from rich.progress import Progress

CLIENTS = 4

Answer = TypeVar("Answer")


def measure(progress: Progress, *, photos: int, queries: int) -> Report:
    """Upload `photos` and search with `queries` of them, once as stored and once as new photos."""
    report = Report("Embedded server")
    with tempfile.TemporaryDirectory() as folder:
        first, *files = [Path(folder, f"{number:05d}.jpg") for number in range(photos + 1)]
        jpegs = make_jpegs(photos + 1, (320, 240), 10_000)
        for file, jpeg in zip([first, *files], jpegs, strict=True):
            file.write_bytes(jpeg)
        with (
            start_embedded_server(Path(folder)) as server,
            Client(server.url, key=server.key, patience_seconds=START_TIMEOUT_SECONDS) as client,
        ):
            client.wait(client.upload(first))  # importing torch takes seconds of the lock
            _measure_calls(report, client, files, queries, progress)
    return report


def _measure_calls(
    report: Report, client: Client, files: list[Path], queries: int, progress: Progress
) -> None:
    bar = progress.add_task("calls", total=len(files) + 2 * queries)

    def timed(call: Callable[[], Answer]) -> tuple[float, Answer]:
        started_at = time.perf_counter()
        response = call()
        progress.advance(bar)
        return time.perf_counter() - started_at, response

    started_at = time.perf_counter()
    with ThreadPoolExecutor(CLIENTS) as pool:
        uploads = list(pool.map(lambda file: timed(partial(client.upload, file)), files))
    uploaded_at = time.perf_counter()
    for _, response in uploads:
        client.wait(response)
    searchable_at = time.perf_counter()
    stored = [
        timed(partial(client.similar, response.file_id))[0] for _, response in uploads[:queries]
    ]
    new = [timed(partial(client.similar, file))[0] for file in files[:queries]]
    for name, seconds, rate in (
        ("upload, 4 clients", [s for s, _ in uploads], len(files) / (uploaded_at - started_at)),
        ("query by stored photo", stored, len(stored) / sum(stored)),
        ("query by new photo", new, len(new) / sum(new)),
    ):
        report.add_latency(name, seconds)
        report.add(f"{name}, rate", rate, "/s")
    report.add(f"{len(files)} photos searchable after", searchable_at - started_at, "s")
