"""Benchmark of the embedded server: upload, describe, search by stored photo and by new photo."""

from __future__ import annotations

import contextlib
import io
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from PIL import Image

from benchmarks.report import Report
from placewise.client import Client
from shared.config.embedded_home import RunningServer, find_running_server
from shared.errors import Unavailable

if TYPE_CHECKING:
    from rich.progress import Progress

START_TIMEOUT_SECONDS = 60.0

Answer = TypeVar("Answer")


def measure(progress: Progress, *, photos: int, queries: int) -> Report:
    """Measure on an empty embedded server, with random textures of 320 x 240 pixels as photos."""
    with tempfile.TemporaryDirectory() as folder:
        made = _draw_photos(Path(folder, "photos"), photos)
        with (
            _start_server(Path(folder, "home")) as running,
            Client(running.url, key=running.key) as client,
        ):
            figures = _run_timed_calls(client, made, queries, progress)
    report = Report("The main job, embedded", details=figures)
    for name, timing in figures["timings"].items():
        report.add(f"{name}, median", timing["median_ms"], "ms")
        report.add(f"{name}, p95", timing["p95_ms"], "ms")
        report.add(f"{name}, rate", timing["per_second"], "/s")
    report.add(f"{photos} photos searchable after", figures["searchable_after_seconds"], "s")
    return report


@contextlib.contextmanager
def _start_server(home: Path) -> Iterator[RunningServer]:
    """Start a server in a process of its own, so that it does not share the GIL with the client."""
    command = [str(Path(sys.executable).with_name("placewise")), "serve"]
    environment = {**os.environ, "PLACEWISE_HOME": str(home), "HOST": "127.0.0.1", "PORT": "0"}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as server:  # noqa: S603
        try:
            deadline = time.monotonic() + START_TIMEOUT_SECONDS
            while (running := find_running_server(home)) is None:
                if server.poll() is not None or time.monotonic() > deadline:
                    raise Unavailable("server_unreachable", "The server did not start.")
                time.sleep(0.1)
            with Client(
                running.url, key=running.key, patience_seconds=START_TIMEOUT_SECONDS
            ) as client:
                client.stats()
            yield running
        finally:
            server.terminate()


def _run_timed_calls(
    client: Client, photos: list[Path], queries: int, progress: Progress
) -> dict[str, Any]:
    bar = progress.add_task("photos", total=len(photos) + 2 * queries)

    def timed(call: Callable[[], Answer]) -> tuple[float, Answer]:
        started = time.perf_counter()
        answer = call()
        progress.advance(bar)
        return time.perf_counter() - started, answer

    started_at = time.perf_counter()
    with ThreadPoolExecutor(4) as pool:
        uploads = list(pool.map(lambda photo: timed(partial(client.upload, photo)), photos))
    uploaded = time.perf_counter() - started_at
    for _, answer in uploads:
        client.wait(answer)
    searchable = time.perf_counter() - started_at
    stored = [timed(partial(client.similar, answer.file_id)) for _, answer in uploads[:queries]]
    new = [timed(partial(client.similar, photo)) for photo in photos[:queries]]
    return {
        "photos": len(photos),
        "searchable_after_seconds": searchable,
        "timings": {
            "upload, 4 at once": _timing_summary([s for s, _ in uploads], uploaded),
            "query by stored photo": _timing_summary([s for s, _ in stored]),
            "query by new photo": _timing_summary([s for s, _ in new]),
        },
    }


def _timing_summary(seconds: list[float], wall_seconds: float | None = None) -> dict[str, Any]:
    ordered = sorted(seconds)
    return {
        "median_ms": statistics.median(ordered) * 1000,
        "p95_ms": ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))] * 1000,
        "per_second": len(ordered) / (wall_seconds or sum(ordered)),
    }


def _draw_photos(folder: Path, count: int) -> list[Path]:
    folder.mkdir()
    rng = np.random.default_rng(0)
    made = []
    for number in range(count):
        coarse = Image.fromarray(rng.integers(0, 256, (15, 20, 3), dtype=np.uint8))
        buffer = io.BytesIO()
        coarse.resize((320, 240), Image.Resampling.BICUBIC).save(buffer, "JPEG", quality=90)
        made.append(folder / f"{number:05d}.jpg")
        made[-1].write_bytes(buffer.getvalue())
    return made
