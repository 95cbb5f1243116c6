"""CPU time per photo from upload to searchable, and uploads per second beside a bare server.

    placewise bench pipeline [--widths 14336,98304] [--photos 320] [--batch 32] [--rounds 5]

A fleet of one process for each service stores and searches JPEGs of 100 kB, with an extractor and a
detector of local features that cost nothing. Reported for each descriptor width, with and without
local features: CPU time of each service, of the extractor's decoders, and of each server, in ms per
photo. The same of an embedded server follows. Uploads are then sent in alternating rounds to a
gateway and to `bare_upload`, a FastAPI server that only stores the file.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import multiprocessing
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import psutil
import torch
import typer
from sqlalchemy import select

import placewise
from lab.benchmarks.load_generator import make_jpegs, multipart_forms, upload_all, wait_for_jobs
from lab.benchmarks.report import Report, integers_option, printed_report
from services.cli import main
from services.cli.output import JsonOption
from shared.catalog.maps import Map, Matching
from shared.descriptors.backbones import normalise_features
from shared.descriptors.extractor import Extractor
from shared.imaging.preprocessing import Pixels
from shared.matching.features import MAX_KEYPOINTS, WORKING_SIDE
from shared.matching.xfeat import DIMENSION, XFeatDetector
from shared.search_api.client import HttpSearchClient
from tests.support.fleet import Fleet, ServiceProcess, open_fleet, start_servers
from tests.support.server import environment
from tests.support.servers.daemon import free_ports

TARGET_OWN_MILLISECONDS, TARGET_DECODER_MILLISECONDS = 1.5, 12.0
TARGET_EMBEDDED = 1.3 * TARGET_OWN_MILLISECONDS
TARGET_SHARE_OF_BARE = 0.5
SIZE, SIZE_BYTES = (1024, 768), 100_000
TEXTURES = 32
CLIENTS = 4
TIMEOUT_SECONDS = 900.0
EXTRACTOR = "test-slow-avg:milliseconds=0,width={}"
FREE_EXTRACTOR = (sys.executable, "-c", "from lab.benchmarks.pipeline import run_free; run_free()")


def bench(
    widths: Annotated[Any, integers_option("Descriptor dimensions, comma-separated.")] = (
        "14336,98304"
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
        cases = list(itertools.product(widths, (Matching.OFF, Matching.ON)))
        bar = progress.add_task("photos", total=len(cases) + 2)
        for width, matching in cases:
            extractor = EXTRACTOR.format(width)
            with open_fleet(servers, extractor=extractor, batch_photos=batch) as fleet:
                fleet["extractor-0"].command = [*FREE_EXTRACTOR, "extractor"]
                fleet.start()
                with fleet.catalog.write() as session:
                    session.scalars(select(Map)).one().matching = matching
                at = f"{width:,} dimensions, local features {matching}"
                _measure_cpu(report, fleet, jpegs, at, photos, batch)
                progress.advance(bar)
        _measure_embedded(report, jpegs, widths[0], photos, batch)
        progress.advance(bar)
        with open_fleet(servers, extractor=EXTRACTOR.format(widths[0])) as fleet:
            fleet.start("search-0", "gateway-0")
            _measure_uploads(report, fleet, jpegs, photos, rounds)
            progress.advance(bar)


def run_free() -> None:
    """Run a `placewise` whose network costs nothing, and whose detector finds the same in all."""
    multiprocessing.set_start_method("fork")  # the extractor of `serve` inherits them
    made = functools.cache(lambda width: normalise_features(torch.randn(TEXTURES, width)).numpy())

    def describe(extractor: Extractor, photos: Sequence[Any], *_: Any) -> Any:
        rows = made(extractor.backbone.width)
        return rows[np.arange(len(photos)) % TEXTURES]

    descriptors = torch.nn.functional.normalize(torch.randn(MAX_KEYPOINTS, DIMENSION))
    found = torch.rand(MAX_KEYPOINTS, 2) * WORKING_SIDE, descriptors

    def find_keypoints(_: XFeatDetector, pixels: Pixels) -> list[tuple[torch.Tensor, torch.Tensor]]:
        return [found] * len(pixels)

    XFeatDetector.find_keypoints = find_keypoints  # type: ignore[assignment]
    Extractor.describe = describe  # type: ignore[assignment]
    main()


def _measure_cpu(
    report: Report, fleet: Fleet, jpegs: Sequence[bytes], at: str, photos: int, batch: int
) -> None:
    # What a process does once: models, decoders, connections, and the kernels of a larger map.
    _upload_and_wait(fleet, jpegs, photos + 2 * batch)

    def cpu_seconds() -> dict[str, float]:
        own = psutil.Process(fleet["extractor-0"].pid).cpu_times()
        return {**fleet.cpu_seconds(), "extractor's own process": own.user + own.system}

    before, started = cpu_seconds(), time.perf_counter()
    _upload_and_wait(fleet, jpegs, photos)
    seconds, after = time.perf_counter() - started, cpu_seconds()
    assert not fleet.crashed, fleet.logs()
    each = {name: 1000 * (after[name] - before[name]) / photos for name in after}
    own = each.pop("extractor's own process")
    decoders = each.pop("extractor-0") - own
    report.add(f"upload to searchable at {at}", photos / seconds, "/s")
    report.add(f"extractor's own process at {at}", own, "ms", at_most=TARGET_OWN_MILLISECONDS)
    report.add(f"decoders at {at}", decoders, "ms", at_most=TARGET_DECODER_MILLISECONDS)
    for name, milliseconds in each.items():
        report.add(f"{name} at {at}", milliseconds, "ms")


def _upload_and_wait(fleet: Fleet, jpegs: Sequence[bytes], photos: int) -> None:
    """Upload the photos and wait until all are searchable."""
    upload_all(fleet.gateway_urls[0], multipart_forms(jpegs, photos), CLIENTS)
    wait_for_jobs(fleet.catalog, TIMEOUT_SECONDS)
    with fleet.catalog.read() as session:
        map_version = session.scalars(select(Map.version)).one()
    with HttpSearchClient(fleet.search_urls, timeout_seconds=10) as search:
        while min(search.status().versions.values(), default=0) < map_version:
            time.sleep(0.2)


def _measure_embedded(
    report: Report, jpegs: Sequence[bytes], width: int, photos: int, batch: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        settings = environment(
            Path(folder, "home"),
            port=(port := free_ports(1)[0]),
            extractor=EXTRACTOR.format(width),
            batch_photos=batch,
            decode_processes=2,
        )
        command, url = [*FREE_EXTRACTOR, "serve"], f"http://127.0.0.1:{port}"
        server = ServiceProcess("serve", command, settings, Path(folder, "log"), f"{url}/livez")
        with _running(server), placewise.connect(url) as client:

            def upload_and_wait(more: int, searchable: int) -> None:
                upload_all(url, multipart_forms(jpegs, more), CLIENTS)
                while client.stats().searchable_images < searchable:
                    time.sleep(0.5)

            def cpu_seconds() -> list[float]:
                (extractor,) = (process := psutil.Process(server.pid)).children()
                spent = [each.cpu_times() for each in (process, extractor, *extractor.children())]
                return [times.user + times.system for times in spent]

            upload_and_wait(before := photos + 2 * batch, before)
            began, started = cpu_seconds(), time.perf_counter()
            upload_and_wait(photos, before + photos)
            seconds = time.perf_counter() - started
            each = 1000 * (np.array(cpu_seconds()) - began) / photos
    at = f"embedded, {width:,} dimensions"
    report.add(f"upload to searchable, {at}", photos / seconds, "/s")
    report.add(f"server's own process, {at}", float(each[0]), "ms")
    report.add(f"extractor's own process, {at}", float(each[1]), "ms", at_most=TARGET_EMBEDDED)
    report.add(f"decoders, {at}", float(each[2:].sum()), "ms", at_most=TARGET_DECODER_MILLISECONDS)


def _measure_uploads(
    report: Report, fleet: Fleet, jpegs: Sequence[bytes], photos: int, rounds: int
) -> None:
    """Measure upload rates without extractors, one server at a time."""
    rates: dict[str, list[float]] = {"gateway": [], "bare": []}
    with _start_bare_server(fleet) as bare:
        targets = {"gateway": (fleet.gateway_urls[0], "/api/v1/upload"), "bare": (bare, "/upload")}
        for url, path in targets.values():
            upload_all(url, multipart_forms(jpegs, 20), CLIENTS, path=path)
        for _ in range(rounds):
            for name, (url, path) in targets.items():
                forms = multipart_forms(jpegs, photos)
                started_at = time.perf_counter()
                upload_all(url, forms, CLIENTS, path=path)
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
    with _running(service):
        yield f"http://127.0.0.1:{port}"


@contextlib.contextmanager
def _running(service: ServiceProcess) -> Iterator[None]:
    service.start()
    try:
        service.wait_until_ready()
        yield
    finally:
        service.kill()
