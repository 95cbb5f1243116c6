"""Extraction throughput: JPEG bytes in, descriptors out, through the extractor's own pipeline.

    placewise bench extract [--extractor anyloc-vits14] [--photos 32] [--device auto] [--rounds 3]

Reported for each maximum batch size: photos per second, CPU time per photo on a CPU, the rate of
floating-point operations relative to that of large matrix products, and peak memory.

Extractors use the weights that are installed, or random weights if there are none: these need the
same time and memory, but their retrieval results are meaningless.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import psutil
import torch
import typer
from numpy.typing import NDArray
from rich.progress import Progress
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from lab.benchmarks.load_generator import make_jpegs
from lab.benchmarks.report import Report, integers_option, printed_report
from services.cli.environment import read_settings
from services.cli.output import JsonOption
from services.extractor.decoder_pool import DecoderPool
from shared.config.settings import Settings
from shared.descriptors.backbones.dinov2 import SHAPES
from shared.descriptors.backbones.dinov2_weights import find_local_weights
from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.inference import Precision, autocast, choose_precision
from shared.descriptors.patches import fit_vocabulary
from shared.descriptors.vocabulary import ClusterCentres
from shared.errors import Misconfigured, PlacewiseError
from shared.extractor_config.configs import ExtractorConfig
from shared.imaging.preprocessing import Pixels
from tests.support.memory import memory_bytes
from tests.support.vit import random_weights, save

SIZE, SIZE_BYTES = (1024, 768), 100_000
TEXTURES = 32
FIT_PHOTOS = 16  # other photos, enough for 64 centres; a photo must not be its own centre
MATRIX_SIZE = {"cpu": 2048, "cuda": 8192}  # rows and columns
MATRIX_ROUNDS = 5

Rows = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class BenchmarkedExtractor:
    """An extractor with its weights."""

    config: ExtractorConfig
    device: torch.device
    settings: Settings
    dino_weights: Path | None
    random: bool

    @classmethod
    def of(cls, extractor: str, device: str, folder: Path) -> BenchmarkedExtractor:
        """Find an extractor's weights; `folder` receives random ones if no others are installed.

        Raises Misconfigured: the extractor or the device is not available.
        """
        settings = read_settings()
        config = settings.extractor_config(extractor)
        weights, random = settings.dino_weights, False
        if config.depth is not None:
            size = config.backbone.removeprefix("dinov2-")
            try:
                weights = find_local_weights(size, weights)
            except Misconfigured as error:
                if error.code != "weights_missing":
                    raise
                weights = save(random_weights(SHAPES[size]), folder / f"{size}.safetensors")
                random = True
        return cls(config, choose_device(device), settings, weights, random)

    def load(self, precision: Precision) -> Extractor:
        return Extractor(
            self.config, self.device, precision=precision, dino_weights=self.dino_weights
        )

    @property
    def title(self) -> str:
        name = (
            torch.cuda.get_device_name(self.device)
            if self.device.type == "cuda"
            else f"{torch.get_num_threads()} CPU threads"
        )
        return f"{self.config.name}{', random weights' if self.random else ''}, {name}"


def bench(
    extractor: Annotated[
        str, typer.Option(help="Extractor name, with options as in EXTRACTOR.")
    ] = "anyloc-vits14",
    photos: Annotated[int, typer.Option(min=1)] = 32,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Device.")] = "auto",
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"], typer.Option(help="Precision.")
    ] = "auto",
    batches: Annotated[
        Any, integers_option("Maximum batch sizes, comma-separated.", "--batch")
    ] = "16",
    rounds: Annotated[int, typer.Option(min=1, help="Passes over all photos.")] = 3,
    as_json: JsonOption = False,
) -> None:
    """Measure extraction throughput, with random weights where no others are installed."""
    made = make_jpegs(FIT_PHOTOS + min(TEXTURES, photos), SIZE, SIZE_BYTES)
    textures = made[FIT_PHOTOS:]
    files = [textures[number % len(textures)] for number in range(photos)]
    with tempfile.TemporaryDirectory() as folder:
        measured = BenchmarkedExtractor.of(extractor, device, Path(folder))
        chosen = choose_precision(precision, measured.config, measured.device)
        with printed_report(f"{measured.title}, {chosen}", as_json) as (report, progress):
            for batch in batches:
                with _open_pipeline(measured, chosen, batch, made[:FIT_PHOTOS]) as pipeline:
                    _measure_pipeline(report, progress, measured.device, pipeline, files, rounds)
            report.details = {
                "random_weights": measured.random,
                "precision": chosen,
                "photos": photos,
                "rounds": rounds,
                "torch": torch.__version__,
            }


def _measure_pipeline(
    report: Report,
    progress: Progress,
    device: torch.device,
    pipeline: _ExtractionPipeline,
    files: Sequence[bytes],
    rounds: int,
) -> None:
    bar = progress.add_task("rounds", total=rounds)
    pipeline.describe(files[: 2 * pipeline.batch])  # kernels are chosen, the decoders are there
    _reset_peak_memory(device)
    seconds, cpu_seconds = [], []
    for _ in range(rounds):
        started_at, cpu_begun = time.perf_counter(), _cpu_seconds()
        pipeline.describe(files)  # on the CPU in the end, which waits for a GPU
        seconds.append(time.perf_counter() - started_at)
        cpu_seconds.append(_cpu_seconds() - cpu_begun)
        progress.advance(bar)
    peak_bytes = _peak_memory_bytes(device)
    rate = len(files) / statistics.median(seconds)
    at = f"batches of {pipeline.batch}"
    report.add(f"extraction, {at}", rate, "photos/s")
    if device.type == "cpu":
        milliseconds = 1000 * statistics.median(cpu_seconds) / len(files)
        report.add(f"CPU time of a photo, {at}", milliseconds, "ms")
    flop = _count_flops(pipeline.made, pipeline.pixels(files[:1])[0])
    ceiling = _matmul_flops_per_second(device, pipeline.made.precision)
    report.add("forward pass of a photo", flop / 1e9, "GFLOP")
    report.add("matrix products on this device", ceiling / 1e9, "GFLOP/s")
    report.add(f"share of it that is reached, {at}", rate * flop / ceiling)
    report.add(f"peak memory, {at}", peak_bytes / 1e6, "MB")


class _ExtractionPipeline:
    """The extractor service's pipeline: decoder processes work one batch ahead of the network."""

    def __init__(self, made: Extractor, decoders: DecoderPool, batch: int) -> None:
        self.made = made
        self.batch = batch
        self.centres: ClusterCentres | None = None
        self._decoders = decoders

    def pixels(self, files: Sequence[bytes]) -> list[Pixels]:
        found = []
        for outcome in self._decoders.decode(files, self.made.preprocessing):
            if isinstance(outcome, PlacewiseError):
                raise outcome
            found.append(outcome.pixels)
        return found

    def describe(self, files: Sequence[bytes]) -> Rows:
        """JPEGs -> (n, dimension)."""
        batches = [files[n : n + self.batch] for n in range(0, len(files), self.batch)]
        rows = []
        with ThreadPoolExecutor(1) as reader:
            ahead = reader.submit(self.pixels, batches[0])
            for following in [*batches[1:], None]:
                photos = ahead.result()
                if following is not None:
                    ahead = reader.submit(self.pixels, following)
                rows.append(self.made.describe(photos, self.centres))
        return np.concatenate(rows)


@contextlib.contextmanager
def _open_pipeline(
    measured: BenchmarkedExtractor, precision: Precision, batch: int, fit_photos: Sequence[bytes]
) -> Iterator[_ExtractionPipeline]:
    with contextlib.closing(DecoderPool(measured.settings)) as decoders:
        pipeline = _ExtractionPipeline(measured.load(precision), decoders, batch)
        pipeline.centres = _fit_or_load_centres(pipeline.made, pipeline.pixels(fit_photos))
        yield pipeline


def _fit_or_load_centres(extractor: Extractor, photos: list[Pixels]) -> ClusterCentres | None:
    """Return the shipped cluster centres, or fit them on the photos if the extractor needs some."""
    if not extractor.config.needs_vocabulary:
        return None
    shipped = extractor.shipped_vocabulary()
    if shipped is not None:
        return shipped[0]
    clusters = extractor.config.clusters
    return fit_vocabulary(extractor, [photos], len(photos), clusters=clusters, seed=0).centres


def _cpu_seconds() -> float:
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def _count_flops(made: Extractor, photo: Pixels) -> float:
    """Count the backbone's floating-point operations per photo; a multiply-add counts as two."""
    # Fused attention is not counted on every device; written out, it always is.
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        made.features(np.stack([photo]))
    return float(counter.get_total_flops())


def _matmul_flops_per_second(device: torch.device, precision: Precision) -> float:
    """Return the best rate of several products of two square matrices, in operations per second."""
    side = MATRIX_SIZE[device.type]
    kind = torch.float32 if precision == "float32" else torch.bfloat16
    one = torch.rand(side, side, device=device, dtype=kind)
    best = 0.0
    with autocast("float32", device):
        for _ in range(MATRIX_ROUNDS):
            started_at = time.perf_counter()
            (one @ one)[0, 0].item()  # waits for the device
            best = max(best, 2 * side**3 / (time.perf_counter() - started_at))
    return best


def _reset_peak_memory(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    else:
        Path(f"/proc/{os.getpid()}/clear_refs").write_text("5")  # proc(5): VmHWM starts anew


def _peak_memory_bytes(device: torch.device) -> float:
    """Return the peak bytes of GPU memory, or of this process without its decoders."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return memory_bytes("VmHWM")
