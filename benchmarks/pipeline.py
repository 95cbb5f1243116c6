"""Benchmark of the pipeline's overhead: CPU time per photo from upload to searchable.

Also compares the upload rate of a gateway with that of a bare FastAPI server that stores the file.
"""

from __future__ import annotations

import contextlib
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from sqlalchemy import select

from benchmarks.fleet import Fleet, Servers, ServiceProcess, start_servers
from benchmarks.load_generator import make_jpegs, multipart_form, upload_all, wait_for_jobs
from benchmarks.report import Report
from shared.catalog.maps import Map
from shared.descriptors.extractor import Extractor
from shared.extractor_config.configs import get_extractor_config
from shared.search_api.client import HttpSearchClient
from tests.support.servers.daemon import free_ports

if TYPE_CHECKING:
    from rich.progress import Progress

TARGET_MILLISECONDS = 30.0
TARGET_SHARE_OF_BARE = 0.5
SIZE, SIZE_BYTES = (1024, 768), 100_000
TEXTURES = 32
CLIENTS = 4
TIMEOUT_SECONDS = 900.0
SERVICES = ("gateway", "extractor", "search", "steward")


def measure(
    progress: Progress, *, widths: Sequence[int], photos: int, batch: int, rounds: int
) -> Report:
    """Measure `photos` of 100 kB per descriptor width in batches of `batch`; then upload rates.

    Uploads go to the gateway and to the bare server in `rounds` alternating rounds.
    """
    report = Report("Around the model, for each photo")
    jpegs = make_jpegs(TEXTURES, SIZE, SIZE_BYTES)
    with start_servers() as servers:
        for width in widths:
            with _open_fleet(servers, width, batch) as fleet:
                fleet.start()
                bar = progress.add_task(f"{width:,} dimensions", total=photos)
                _measure_cpu(report, fleet, jpegs, width, photos, batch, progress, bar)
        with _open_fleet(servers, widths[0], batch) as fleet:
            bar = progress.add_task("gateway beside a bare one", total=2 * rounds * photos)
            fleet.start("search-0-0", "gateway-0")
            _measure_uploads(report, fleet, jpegs, photos, rounds, lambda: progress.advance(bar))
    report.details = {
        "photo_bytes": statistics.mean(len(photo) for photo in jpegs),
        "photos": photos,
        "batch": batch,
    }
    return report


@contextlib.contextmanager
def _open_fleet(servers: Servers, width: int, batch: int) -> Iterator[Fleet]:
    with (
        tempfile.TemporaryDirectory() as folder,
        Fleet(
            Path(folder),
            servers,
            extractor=_test_extractor(width),
            batch_photos=batch,
        ) as fleet,
    ):
        yield fleet


def _test_extractor(width: int) -> str:
    return f"test-slow-avg:milliseconds=0,width={width}"


def _measure_cpu(
    report: Report,
    fleet: Fleet,
    jpegs: Sequence[bytes],
    width: int,
    photos: int,
    batch: int,
    progress: Progress,
    bar: object,
) -> None:
    _upload_and_wait(fleet, jpegs, 2 * batch, lambda left: None)  # models, decoders, connections
    before, servers_before = fleet.cpu_seconds(), fleet.server_cpu_seconds()
    _upload_and_wait(
        fleet,
        jpegs,
        photos,
        lambda left: progress.update(bar, completed=photos - left),  # type: ignore[arg-type]
    )
    after, servers_after = fleet.cpu_seconds(), fleet.server_cpu_seconds()
    assert not fleet.crashed, fleet.logs()
    ours = {
        service: sum(
            1000 * (after[name] - before[name]) / photos
            for name in after
            if name.startswith(service)
        )
        for service in SERVICES
    }
    model = _model_milliseconds(width, batch)
    ours["extractor"] -= model
    at = f"at {width:,} dimensions"
    for service, milliseconds in ours.items():
        report.add(f"{service} {at}", milliseconds, "ms")
    report.add(f"ours {at}", sum(ours.values()), "ms", at_most=TARGET_MILLISECONDS)
    report.add(f"(the model's own, taken off) {at}", model, "ms")
    for name, seconds in servers_after.items():
        used = 1000 * (seconds - servers_before[name]) / photos
        report.add(f"{name} {at}", used, "ms")


def _upload_and_wait(fleet: Fleet, jpegs: Sequence[bytes], photos: int, on_left: object) -> None:
    """Upload the photos and wait until all are searchable."""
    forms = [multipart_form(jpegs[number % len(jpegs)]) for number in range(photos)]
    upload_all(fleet.gateway_urls[0], forms, CLIENTS)
    wait_for_jobs(fleet.catalog, TIMEOUT_SECONDS, on_left)  # type: ignore[arg-type]
    with fleet.catalog.read() as session:
        map_version = session.scalars(select(Map.version)).one()
    with HttpSearchClient(fleet.search_urls, timeout_seconds=10) as search:
        while min(search.status().versions.values(), default=0) < map_version:
            time.sleep(0.2)


def _model_milliseconds(width: int, batch: int) -> float:
    """Return the CPU time per photo of the fake backbone, which only samples pixels."""
    recipe = get_extractor_config(_test_extractor(width), allow_test_extractors=True)
    extractor = Extractor(recipe, torch.device("cpu"))
    pixels = np.zeros((batch, 224, 224, 3), np.uint8)
    extractor.describe(pixels, None)
    started_at = time.process_time()
    for _ in range(10):
        extractor.describe(pixels, None)
    return 1000 * (time.process_time() - started_at) / 10 / batch


def _measure_uploads(
    report: Report,
    fleet: Fleet,
    jpegs: Sequence[bytes],
    photos: int,
    rounds: int,
    on_done: object,
) -> None:
    """Measure upload rates without extractors, one server at a time."""
    rates: dict[str, list[float]] = {"gateway": [], "bare": []}
    with _start_bare_server(fleet) as bare:
        targets = {
            "gateway": (fleet.gateway_urls[0], "/api/v1/upload"),
            "bare": (bare, "/upload"),
        }
        for url, path in targets.values():
            upload_all(url, [multipart_form(jpegs[0]) for _ in range(20)], CLIENTS, path=path)
        for _ in range(rounds):
            for name, (url, path) in targets.items():
                forms = [multipart_form(jpegs[number % len(jpegs)]) for number in range(photos)]
                started_at = time.perf_counter()
                upload_all(url, forms, CLIENTS, path=path, on_done=on_done)  # type: ignore[arg-type]
                rates[name].append(photos / (time.perf_counter() - started_at))
    for name, values in rates.items():
        report.add(
            f"uploads to the {name} server" if name == "bare" else f"uploads to the {name}",
            statistics.median(values),
            "/s",
        )
    ratios = [ours / theirs for ours, theirs in zip(rates["gateway"], rates["bare"], strict=True)]
    report.add("gateway, of bare", statistics.median(ratios), at_least=TARGET_SHARE_OF_BARE)


@contextlib.contextmanager
def _start_bare_server(fleet: Fleet) -> Iterator[str]:
    port = free_ports(1)[0]
    service = ServiceProcess(
        "bare",
        [sys.executable, "-m", "benchmarks.bare_upload", str(port)],
        fleet["gateway-0"].environment | {"PYTHONPATH": str(Path(__file__).parents[1])},
        fleet["gateway-0"].log_path.with_name("bare.log"),
        f"http://127.0.0.1:{port}/readyz",
    )
    service.start()
    try:
        service.wait_until_ready()
        yield f"http://127.0.0.1:{port}"
    finally:
        service.kill()
