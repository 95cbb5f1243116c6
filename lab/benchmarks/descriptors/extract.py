"""Descriptor extraction against AnyLoc as published, and against the device's peak rate.

    placewise bench extract [--extractor anyloc-vits14] [--photos 32] [--device auto] [--rounds 3]

JPEG bytes go in, descriptors come out, in alternating rounds of both implementations; on a busy
CPU, compare their CPU times. Reported: photos per second and CPU time per photo of both; their
median ratio; the numerical difference of the descriptors; the rate of floating-point operations
relative to that of large matrix products; peak memory.

Extractors use the weights that are installed, or random weights if there are none: these need the
same time and memory, but their retrieval results are meaningless.

The AnyLoc baseline follows the description in the authors' paper and code: one photo at a time,
float32, the whole network although a hook takes the features from the middle, and VLAD as a loop
over the clusters with all residuals in memory. Attention is written out on a CPU, as in Meta's
code, and fused on a GPU, as with xFormers. Photos are decoded and resized as in Placewise, so that
both compute the same descriptor.
"""

from __future__ import annotations

import contextlib
import io
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.functional import normalize
from torch.utils.flop_counter import FlopCounterMode

from lab.benchmarks.fleet.load_generator import make_jpegs
from lab.benchmarks.report import Report
from services.cli.environment import read_settings
from services.extractor.decoder_pool import DecoderPool
from shared.config.settings import Settings
from shared.descriptors.backbones.dinov2 import SHAPES, Dinov2
from shared.descriptors.backbones.dinov2_weights import find_local_weights
from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.inference import Precision, autocast, choose_precision
from shared.descriptors.patches import fit_vocabulary
from shared.descriptors.vocabulary import ClusterCentres
from shared.errors import Misconfigured, PlacewiseError
from shared.extractor_config.configs import FACETS, ExtractorConfig
from shared.imaging.preprocessing import Pixels, get_preprocessing
from tests.support.memory import memory_bytes
from tests.support.vit import random_weights, save

if TYPE_CHECKING:
    from rich.progress import Progress


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
        """Load an extractor; `folder` receives random weights if no others are installed.

        Raises:
            Misconfigured: the extractor or the device is not available.
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


def fit_or_load_centres(extractor: Extractor, photos: list[Pixels]) -> ClusterCentres | None:
    """Return the shipped cluster centres, or fit them on the photos if the extractor needs some."""
    if not extractor.config.needs_vocabulary:
        return None
    shipped = extractor.shipped_vocabulary()
    if shipped is not None:
        return shipped[0]
    clusters = extractor.config.clusters
    return fit_vocabulary(extractor, [photos], len(photos), clusters=clusters, seed=0).centres


class _ReferenceAnyLoc:
    def __init__(self, measured: BenchmarkedExtractor, centres: NDArray[np.float32]) -> None:
        """(K, width) centres. The extractor is one of the `anyloc-` ones, with hard VLAD."""
        config, device = measured.config, measured.device
        assert config.layer is not None
        assert config.preprocessing is not None
        size = config.backbone.removeprefix("dinov2-")
        self._device = device
        self._preprocessing = get_preprocessing(config.preprocessing)
        self._centres = torch.from_numpy(centres).to(device)
        whole = SHAPES[size].depth - 1
        self._network = Dinov2(size, whole, "token", device, measured.dino_weights)
        self._third = None if config.facet == "token" else FACETS.index(config.facet or "value")
        blocks: Any = self._network._vit.blocks
        for block in blocks:
            block.attn.fused_attn = device.type == "cuda"
        hooked = blocks[config.layer]
        (hooked if self._third is None else hooked.attn.qkv).register_forward_hook(
            self._store_output
        )
        self._output = torch.empty(0)

    def describe(self, photos: Sequence[bytes]) -> NDArray[np.float32]:
        """JPEGs -> (n, K * width), rows of length 1."""
        return np.stack([self._describe(photo) for photo in photos])

    @torch.inference_mode()
    def _describe(self, photo: bytes) -> NDArray[np.float32]:
        with Image.open(io.BytesIO(photo)) as image:
            pixels = self._preprocessing.apply(image.convert("RGB"))
        with autocast("float32", self._device):
            self._network.features(torch.from_numpy(np.array(pixels))[None])
            found = self._output[0, 1:]
            if self._third is not None:
                found = found.chunk(3, dim=-1)[self._third]
            row: NDArray[np.float32] = vlad_in_loops(normalize(found, dim=-1), self._centres)
        return row

    def _store_output(self, _module: Any, _arguments: Any, output: torch.Tensor) -> None:
        self._output = output


def vlad_in_loops(features: torch.Tensor, centres: torch.Tensor) -> NDArray[np.float32]:
    """Compute (K * width,) unit VLAD of (patches, width) unit features and (K, width) centres."""
    labels = (features @ normalize(centres, dim=-1).T).argmax(dim=-1).cpu()
    residuals = features[:, None] - centres[None]  # (patches, K, width)
    blocks = torch.zeros_like(centres)
    for cluster in set(labels.tolist()):
        blocks[cluster] = normalize(residuals[labels == cluster, cluster].sum(dim=0), dim=0)
    row: NDArray[np.float32] = normalize(blocks.flatten(), dim=0).cpu().numpy()
    return row


TARGET_SPEEDUP = 2.0
SIZE, SIZE_BYTES = (1024, 768), 100_000
TEXTURES = 32
FIT_PHOTOS = 16  # other photos, enough for 64 centres; a photo must not be its own centre
MATRIX_SIZE = {"cpu": 2048, "cuda": 8192}  # rows and columns
MATRIX_ROUNDS = 5

Rows = NDArray[np.float32]


def measure(
    progress: Progress,
    *,
    extractor: str,
    photos: int,
    device: str,
    batches: Sequence[int],
    precision: Literal["auto", "float32", "bfloat16"],
    rounds: int,
) -> Report:
    """Run `rounds` of `photos` with both implementations.

    With several maximum batch sizes, the published one, which takes one photo at a time, is
    measured beside the largest.

    Only `anyloc-` extractors with hard VLAD are published and compared; others are only measured.
    """
    made = make_jpegs(FIT_PHOTOS + min(TEXTURES, photos), SIZE, SIZE_BYTES)
    textures = made[FIT_PHOTOS:]
    files = [textures[number % len(textures)] for number in range(photos)]
    with tempfile.TemporaryDirectory() as folder:
        measured = BenchmarkedExtractor.of(extractor, device, Path(folder))
        chosen = choose_precision(precision, measured.config, measured.device)
        report = Report(f"{measured.title}, {chosen}")
        for number, batch in enumerate(batches):
            with _open_pipeline(measured, chosen, batch, made[:FIT_PHOTOS]) as pipeline:
                suffix = f", batches of {batch}" if len(batches) > 1 else ""
                _run_rounds(
                    report,
                    progress,
                    measured,
                    pipeline,
                    files,
                    rounds,
                    suffix=suffix,
                    compare=number == len(batches) - 1,
                )
    report.details = {
        "random_weights": measured.random,
        "precision": chosen,
        "photos": photos,
        "batch": batches[0] if len(batches) == 1 else list(batches),
        "rounds": rounds,
        "torch": torch.__version__,
    }
    return report


def _run_rounds(
    report: Report,
    progress: Progress,
    measured: BenchmarkedExtractor,
    pipeline: _ExtractionPipeline,
    files: Sequence[bytes],
    rounds: int,
    *,
    suffix: str,
    compare: bool,
) -> None:
    bar = progress.add_task("rounds", total=rounds)
    pipeline.describe(files[: 2 * pipeline.batch])  # kernels are chosen, the decoders are there
    ours, published = _RoundTimings(), _RoundTimings()
    reference, expected = None, None
    if compare and measured.config.depth is not None and measured.config.aggregator == "vlad":
        assert pipeline.centres is not None
        reference = _ReferenceAnyLoc(measured, pipeline.centres.array)
        reference.describe(files[:1])
    _reset_peak_memory(measured.device)
    rows = ours.run(lambda: pipeline.describe(files))
    peak_bytes = _peak_memory_bytes(measured.device)
    for number in range(rounds):
        if number:
            ours.run(lambda: pipeline.describe(files))
        if reference is not None:
            expected = published.run(partial(reference.describe, files))
        progress.advance(bar)
    rate = len(files) / statistics.median(ours.seconds)
    report.add(f"this pipeline{suffix}", rate, "photos/s")
    if measured.device.type == "cpu":
        report.add(f"CPU time of a photo{suffix}", ours.cpu_milliseconds(len(files)), "ms")
    if expected is not None:
        report.add("as published", len(files) / statistics.median(published.seconds), "photos/s")
        if measured.device.type == "cpu":
            milliseconds = published.cpu_milliseconds(len(files))
            report.add("CPU time of a photo as published", milliseconds, "ms")
        pairs = zip(published.seconds, ours.seconds, strict=True)
        speedup = statistics.median(slow / quick for slow, quick in pairs)
        report.add("times as fast", speedup, at_least=TARGET_SPEEDUP)
        report.add("largest difference of two numbers", float(np.abs(rows - expected).max()))
        report.add("least cosine of two descriptors", float((rows * expected).sum(axis=1).min()))
    flop = _count_flops(pipeline.made, pipeline.pixels(files[:1])[0])
    ceiling = _matmul_flops_per_second(measured.device, pipeline.made.precision)
    report.add("forward pass of a photo", flop / 1e9, "GFLOP")
    report.add("matrix products on this device", ceiling / 1e9, "GFLOP/s")
    report.add(f"share of it that this pipeline reaches{suffix}", rate * flop / ceiling)
    report.add(f"peak memory{suffix}", peak_bytes / 1e6, "MB")


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
        pipeline.centres = fit_or_load_centres(pipeline.made, pipeline.pixels(fit_photos))
        yield pipeline


@dataclass(slots=True)
class _RoundTimings:
    """Timings of one implementation by round."""

    seconds: list[float] = field(default_factory=list)
    cpu_seconds: list[float] = field(default_factory=list)
    """With those of the decoding children."""

    def run(self, do: Callable[[], Rows]) -> Rows:
        """Return the descriptors on the CPU, which also waits for the GPU."""
        started_at, cpu_begun = time.perf_counter(), _cpu_seconds()
        rows = do()
        self.seconds.append(time.perf_counter() - started_at)
        self.cpu_seconds.append(_cpu_seconds() - cpu_begun)
        return rows

    def cpu_milliseconds(self, photos: int) -> float:
        """CPU time per photo."""
        return 1000 * statistics.median(self.cpu_seconds) / photos


def _cpu_seconds() -> float:
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def _count_flops(made: Extractor, photo: Pixels) -> float:
    """Count the backbone's floating-point operations per photo; a multiply-add counts as two."""
    # Fused attention is not counted on every device; written out, it always is.
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        made.features(photo[None])
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
