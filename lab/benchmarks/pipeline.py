"""CPU time per photo from upload to searchable, and uploads per second beside a bare server.

    placewise bench pipeline [--widths 7168,98304] [--photos 320] [--batch 32] [--rounds 5]

A fleet of one process for each service describes JPEGs of 100 kB with a fake backbone. Reported for
each descriptor width: CPU time of each service, without that of the backbone, and of each server,
in ms per photo. Uploads are then sent in alternating rounds to a gateway and to `bare_upload`, a
FastAPI server that only stores the file.
"""

from __future__ import annotations

import contextlib
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.progress import TaskID
from sqlalchemy import select

from lab.benchmarks.fleet import Fleet, ServiceProcess, open_fleet, start_servers
from lab.benchmarks.load_generator import (
    make_jpegs,
    multipart_forms,
    upload_all,
    wait_for_jobs,
)
from lab.benchmarks.report import Report, integers_option, printed_report
from services.cli.output import JsonOption
from shared.catalog.maps import Map
from shared.descriptors.extractor import Extractor
from shared.extractor_config.configs import get_extractor_config
from shared.search_api.client import HttpSearchClient
from tests.support.servers.daemon import free_ports

TARGET_MILLISECONDS = {7168: 20.0, 98304: 25.0}
TARGET_SHARE_OF_BARE = 0.5
SIZE, SIZE_BYTES = (1024, 768), 100_000
TEXTURES = 32
CLIENTS = 4
TIMEOUT_SECONDS = 900.0
SERVICES = ("gateway", "extractor", "search", "steward")


def bench(
    widths: Annotated[Any, integers_option("Descriptor dimensions, comma-separated.")] = (
        "7168,98304"
    ),
    photos: Annotated[int, typer.Option(min=1)] = 320,
    batch: Annotated[int, typer.Option(min=1, help="Maximum batch size.")] = 32,
    rounds: Annotated[int, typer.Option(min=1, help="Upload rounds per gateway.")] = 5,
    as_json: JsonOption = False,
) -> None:
    """Measure CPU time per photo outside the model, and upload throughput."""
    jpegs = make_jpegs(TEXTURES, SIZE, SIZE_BYTES)
    with (
        printed_report("CPU time per photo outside the model", as_json) as (report, progress),
        start_servers() as servers,
    ):
        for width in widths:
            extractor = _test_extractor(width)
            with open_fleet(servers, extractor=extractor, batch_photos=batch) as fleet:
                fleet.start()
                bar = progress.add_task(f"{width:,} dimensions", total=photos)

                def show(left: int, bar: TaskID = bar) -> None:
                    progress.update(bar, completed=photos - left)

                _measure_cpu(report, fleet, jpegs, width, photos, batch, show)
        with open_fleet(servers, extractor=_test_extractor(widths[0])) as fleet:
            bar = progress.add_task("uploads", total=2 * rounds * photos)
            fleet.start("search-0-0", "gateway-0")
            _measure_uploads(report, fleet, jpegs, photos, rounds, lambda: progress.advance(bar))
        report.details = {
            "photo_bytes": statistics.mean(len(photo) for photo in jpegs),
            "photos": photos,
            "batch": batch,
        }


def _test_extractor(width: int) -> str:
    return f"test-slow-avg:milliseconds=0,width={width}"


def _measure_cpu(
    report: Report,
    fleet: Fleet,
    jpegs: Sequence[bytes],
    width: int,
    photos: int,
    batch: int,
    on_left: Callable[[int], object],
) -> None:
    # What a process does once: models, decoders, connections, and the kernels of a larger map.
    _upload_and_wait(fleet, jpegs, photos + 2 * batch, lambda left: None)
    before = fleet.cpu_seconds()
    _upload_and_wait(fleet, jpegs, photos, on_left)
    after = fleet.cpu_seconds()
    assert not fleet.crashed, fleet.logs()
    each = {name: 1000 * (after[name] - before[name]) / photos for name in after}
    used = {
        service: sum(each[name] for name in each if name.startswith(service))
        for service in SERVICES
    }
    model = _model_milliseconds(width, batch)
    used["extractor"] -= model
    at = f"at {width:,} dimensions"
    for service, milliseconds in used.items():
        report.add(f"{service} {at}", milliseconds, "ms")
    target = TARGET_MILLISECONDS.get(width)
    report.add(f"all services {at}", sum(used.values()), "ms", at_most=target)
    report.add(f"the backbone, not included, {at}", model, "ms")
    for server in fleet.servers.processes:
        report.add(f"{server} {at}", each[server], "ms")


def _upload_and_wait(
    fleet: Fleet, jpegs: Sequence[bytes], photos: int, on_left: Callable[[int], object]
) -> None:
    """Upload the photos and wait until all are searchable."""
    upload_all(fleet.gateway_urls[0], multipart_forms(jpegs, photos), CLIENTS)
    wait_for_jobs(fleet.catalog, TIMEOUT_SECONDS, on_left)
    with fleet.catalog.read() as session:
        map_version = session.scalars(select(Map.version)).one()
    with HttpSearchClient(fleet.search_urls, timeout_seconds=10) as search:
        while min(search.status().versions.values(), default=0) < map_version:
            time.sleep(0.2)


def _model_milliseconds(width: int, batch: int) -> float:
    """Return the CPU time per photo of the fake backbone, which only samples pixels."""
    config = get_extractor_config(_test_extractor(width), allow_test_extractors=True)
    extractor = Extractor(config, torch.device("cpu"))
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
    on_done: Callable[[], object],
) -> None:
    """Measure upload rates without extractors, one server at a time."""
    rates: dict[str, list[float]] = {"gateway": [], "bare": []}
    with _start_bare_server(fleet) as bare:
        targets = {
            "gateway": (fleet.gateway_urls[0], "/api/v1/upload"),
            "bare": (bare, "/upload"),
        }
        for url, path in targets.values():
            upload_all(url, multipart_forms(jpegs, 20), CLIENTS, path=path)
        for _ in range(rounds):
            for name, (url, path) in targets.items():
                forms = multipart_forms(jpegs, photos)
                started_at = time.perf_counter()
                upload_all(url, forms, CLIENTS, path=path, on_done=on_done)
                rates[name].append(photos / (time.perf_counter() - started_at))
    for name, values in rates.items():
        report.add(f"uploads to the {name} server", statistics.median(values), "/s")
    ratios = [ours / theirs for ours, theirs in zip(rates["gateway"], rates["bare"], strict=True)]
    report.add("gateway / bare server", statistics.median(ratios), at_least=TARGET_SHARE_OF_BARE)


@contextlib.contextmanager
def _start_bare_server(fleet: Fleet) -> Iterator[str]:
    port = free_ports(1)[0]
    service = ServiceProcess(
        "bare",
        [sys.executable, "-m", "lab.benchmarks.bare_upload", str(port)],
        fleet["gateway-0"].environment | {"PYTHONPATH": str(Path(__file__).parents[2])},
        fleet["gateway-0"].log_path.with_name("bare.log"),
        f"http://127.0.0.1:{port}/readyz",
    )
    service.start()
    try:
        service.wait_until_ready()
        yield f"http://127.0.0.1:{port}"
    finally:
        service.kill()
