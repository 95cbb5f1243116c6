"""`placewise bench`: timings of the main job, on this machine."""

from __future__ import annotations

import contextlib
import io
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image
from rich.table import Table

from services.cli.bench_catalog.command import bench_catalog
from services.cli.output import JsonOption, answers, explained, print_json, progress_bar
from shared.client import Client, Json, retry_while_away
from shared.errors import Unavailable
from shared.home import RunningServer, running_server

START_SECONDS = 60.0

app = typer.Typer(help="Timings on this machine.", no_args_is_help=True)


@app.callback()
def _bench() -> None:
    """A group, so that each benchmark has its own name."""


app.command("catalog")(bench_catalog)


@app.command("spine")
def spine(
    photos: Annotated[int, typer.Option(min=2)] = 200,
    queries: Annotated[int, typer.Option(min=1)] = 50,
    as_json: JsonOption = False,
) -> None:
    """Upload, describe, search by stored photo and by new photo, on an empty embedded server.

    The photos are random textures of 320 x 240 pixels: timings need no places.
    """
    with explained(as_json), tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        made = _make_photos(Path(folder, "photos"), photos)
        with (
            _server(Path(folder, "home")) as running,
            Client(running.url, key=running.key) as client,
        ):
            figures = _measure(client, made, queries, progress)
    if as_json:
        print_json(figures)
        return
    table = Table("what", "median", "p95", "rate")
    for name, value in figures["timings"].items():
        table.add_row(
            name,
            f"{value['median_ms']:.1f} ms",
            f"{value['p95_ms']:.1f} ms",
            f"{value['per_second']:.1f} /s",
        )
    answers.print(table)
    answers.print(f"{photos} photos, searchable {figures['searchable_after_seconds']:.1f} s in all")


@contextlib.contextmanager
def _server(home: Path) -> Iterator[RunningServer]:
    """A server in a process of its own: in ours it would share the interpreter with the client."""
    command = [str(Path(sys.executable).with_name("placewise")), "serve"]
    environment = {**os.environ, "PLACEWISE_HOME": str(home), "HOST": "127.0.0.1", "PORT": "0"}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as server:  # noqa: S603
        try:
            deadline = time.monotonic() + START_SECONDS
            while (running := running_server(home)) is None:
                if server.poll() is not None or time.monotonic() > deadline:
                    raise Unavailable("server_unreachable", "The server did not start.")
                time.sleep(0.1)
            retry_while_away(lambda: Client(running.url, key=running.key).stats(), START_SECONDS)
            yield running
        finally:
            server.terminate()


def _measure(client: Client, photos: list[Path], queries: int, progress) -> Json:  # type: ignore[no-untyped-def]
    bar = progress.add_task("photos", total=len(photos) + 2 * queries)

    def timed(call) -> tuple[float, Json]:  # type: ignore[no-untyped-def]
        started = time.perf_counter()
        answer = call()
        progress.advance(bar)
        return time.perf_counter() - started, answer

    begun = time.perf_counter()
    with ThreadPoolExecutor(4) as pool:
        uploads = list(pool.map(lambda photo: timed(lambda: client.upload(photo)), photos))
    uploaded = time.perf_counter() - begun
    for _, answer in uploads:
        client.wait_for(answer["job_id"])
    searchable = time.perf_counter() - begun
    stored = [
        timed(lambda a=answer: client.similar_to(a["file_id"])) for _, answer in uploads[:queries]
    ]
    new = [timed(lambda p=photo: client.similar_to_file(p)) for photo in photos[:queries]]
    return {
        "photos": len(photos),
        "searchable_after_seconds": searchable,
        "timings": {
            "upload, 4 at once": _figures([s for s, _ in uploads], uploaded),
            "query by stored photo": _figures([s for s, _ in stored]),
            "query by new photo": _figures([s for s, _ in new]),
        },
    }


def _figures(seconds: list[float], wall_seconds: float | None = None) -> Json:
    ordered = sorted(seconds)
    return {
        "median_ms": statistics.median(ordered) * 1000,
        "p95_ms": ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))] * 1000,
        "per_second": len(ordered) / (wall_seconds or sum(ordered)),
    }


def _make_photos(folder: Path, count: int) -> list[Path]:
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
