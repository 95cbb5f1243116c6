"""Training: photos per second, share of time spent waiting for photos, and recall gained.

    placewise bench train [--places 300] [--epochs 20] [--image-size 112] [--device auto]

The first part times loading, the network alone, and both together, at 224 pixels. The second trains
a ResNet-18 with GeM from random weights on a generated city, and reports R@1 (25 m rule) of the
untrained and of the trained network on other streets of that city and on a city of another style,
with the 95 % interval of the difference.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from lab.benchmarks.generated_city import generate_city
from lab.benchmarks.report import Report
from lab.city.plan import CityOptions
from lab.datasets.dataset import EvaluationSet, TrainingPlace
from lab.datasets.open_dataset import open_evaluation_set
from lab.evaluation.query_clusters import cluster_queries
from lab.evaluation.ranking import evaluate_recall
from lab.evaluation.recall import compute_hits
from lab.training import run
from lab.training.arguments import build_arguments
from lab.training.checkpointing import seed_everything
from lab.training.data import (
    Batch,
    PhotoTransform,
    PlaceBatchSampler,
    PlaceDataset,
    load_batches,
    to_tensor,
)
from lab.training.losses import make_loss, make_miner
from lab.training.model_describer import ModelDescriber
from lab.training.model_factory import make_model
from lab.training.resolve import Device, resolve_device
from lab.training.run_control import NullDisplay, StopRequest
from lab.training.training_loop import make_optimizer
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.model import VprModel
from shared.evaluation.bootstrap import paired_differences

if TYPE_CHECKING:
    from rich.progress import Progress

TARGET_POINTS = 30.0
"""of R@1 over the untrained network"""
MAX_WAIT_SHARE = 0.05
"""on a GPU"""


def measure(
    progress: Progress,
    *,
    places: int,
    epochs: int,
    image_size: int,
    photos: int,
    workers: int,
    device: str,
    seed: int,
) -> Report:
    """Measure throughput at 224 pixels, and the recall gained on a generated city.

    The network is a ResNet-18 with GeM and MultiSimilarityLoss, from random weights.
    """
    chosen = resolve_device(build_arguments({"accelerator": device}))
    report = Report(f"training on {chosen.torch_device.type}")
    with tempfile.TemporaryDirectory(prefix="placewise-bench-") as folder:
        out = Path(folder)
        pace = _measure_throughput(progress, out / "pace", photos, workers, chosen)
        for what, rate in pace.reading.items():
            report.add(f"photos read to 224 pixels: {what}", rate, "photos/s")
        report.add("photos that the network learns from", pace.network, "photos/s")
        report.add("photos learned from, reading included", pace.training, "photos/s")
        report.add(
            "share of the time waiting for photos",
            pace.share_waiting,
            at_most=MAX_WAIT_SHARE if chosen.accelerator == "gpu" else None,
        )
        report.add(
            "reading, as a multiple of the network's pace",
            pace.reading["with its workers"] / pace.network,
            at_least=1.0,
        )
        learnt = _measure_learning(progress, out, places, epochs, image_size, workers, chosen, seed)
        for where, gain in learnt.items():
            report.add(f"R@1 untrained, {where}", 100 * gain.untrained, "%")
            report.add(f"R@1 trained, {where}", 100 * gain.trained, "%")
            report.add(f"points gained, {where}", 100 * gain.mean, "points", at_least=TARGET_POINTS)
            report.add(f"points gained at least (95 %), {where}", 100 * gain.low, "points")
        report.details = {
            "torch": torch.__version__,
            "learning": {where: asdict(gain) for where, gain in learnt.items()},
            "seed": seed,
        }
    return report


PHOTO_SIZE = (160, 120)
"""width and height of the generated photos"""
VIEWS = 2
TRAINING_PLACES_PER_BATCH = 16


@dataclass(frozen=True, slots=True)
class RecallGain:
    """R@1 from 0 to 1; the gain's 95 % interval is a paired bootstrap over clusters of queries."""

    untrained: float
    trained: float
    mean: float
    low: float
    high: float
    queries: int
    fingerprint: str


def _measure_learning(
    progress: Progress,
    folder: Path,
    places: int,
    epochs: int,
    image_size: int,
    workers: int,
    device: Device,
    seed: int,
) -> dict[str, RecallGain]:
    """Return the gain by evaluation set: `other streets` and `another catalogue`."""
    width, height = PHOTO_SIZE
    here = CityOptions(places, VIEWS, places, seed, 0, 0.0, width, height)
    elsewhere = replace(here, seed=seed + 1, catalogue_seed=1, train=False)
    sets = {
        "other streets": folder / "here",
        "another catalogue": folder / "elsewhere",
    }
    for options, out in zip((here, elsewhere), sets.values(), strict=True):
        generate_city(options, out, progress)
    arguments = _training_arguments(
        folder / "here", folder / "runs", epochs, image_size, workers, device, seed
    )
    report = run.run(
        build_arguments({**arguments, "run_name": "gem"}), NullDisplay(), StopRequest()
    )
    trained = load_checkpoint(Path(report["best"]["path"])).model
    seed_everything(seed)
    untrained = make_model(build_arguments(arguments), NullDisplay(), resuming=False)
    return {
        name: measure_gain(untrained, trained, open_evaluation_set(out), image_size, device)
        for name, out in sets.items()
    }


def measure_gain(
    untrained: VprModel,
    trained: VprModel,
    evaluation_set: EvaluationSet,
    image_size: int,
    device: Device,
) -> RecallGain:
    """Return the difference of R@1 of two networks on the same queries."""
    within = []
    for model in (untrained, trained):
        describe = ModelDescriber(
            model.to(device.torch_device), device.torch_device, (image_size, image_size)
        )
        ranked = evaluate_recall(describe, evaluation_set, ks=(1,)).ranked.indices
        within.append(compute_hits(ranked, evaluation_set.positives)[:, :1].astype(np.float64))
    (difference,) = paired_differences(
        within[1], within[0], cluster_queries(evaluation_set.queries).labels
    )
    assert difference.low is not None
    assert difference.high is not None
    return RecallGain(
        float(within[0].mean()),
        float(within[1].mean()),
        difference.mean,
        difference.low,
        difference.high,
        len(evaluation_set.queries),
        evaluation_set.fingerprint,
    )


def _training_arguments(
    data_root: Path,
    out: Path,
    epochs: int,
    image_size: int,
    workers: int,
    device: Device,
    seed: int,
) -> dict[str, Any]:
    return {
        "data_root": str(data_root),
        "default_root_dir": str(out),
        "accelerator": device.accelerator,
        "faiss_gpu": False,
        "pretrained": False,
        "layers_to_freeze": -1,
        "agg_arch": "GeM",
        "augmentation": "none",  # light and weather already differ between the sessions
        "image_size": image_size,
        "batch_size": TRAINING_PLACES_PER_BATCH,
        "img_per_place": 4,
        "min_img_per_place": 4,
        "lr": 1e-3,
        "warmpup_steps": 20,
        "milestones": [epochs * 3 // 4, epochs * 9 // 10],
        "max_epochs": epochs,
        "check_val_every_n_epoch": max(1, epochs // 4),
        "num_workers": workers,
        "show_data_stats": False,
        "logger": "none",
        "seed": seed,
    }


IMAGE_PIXELS = 224
TRANSFORM = PhotoTransform((IMAGE_PIXELS, IMAGE_PIXELS))
STORED_PHOTO_SIZE = (960, 1280)
"""height and width of a photo as cameras and street view give them"""
DISTINCT_PHOTOS = 32
"""number of generated photos; they are read repeatedly, from the page cache"""
PHOTOS_PER_PLACE = 4
PLACES_PER_BATCH = 8
WARM_UP_BATCHES = 2


@dataclass(frozen=True, slots=True)
class TrainingThroughput:
    """Rates in photos per second."""

    reading: dict[str, float]
    """loading and augmentation, by method"""
    network: float
    """forward, loss, backward and optimizer step, without loading"""
    training: float
    """loading and training together"""
    share_waiting: float
    """share of the training time spent waiting for photos"""


def _measure_throughput(
    progress: Progress, folder: Path, photos: int, workers: int, device: Device
) -> TrainingThroughput:
    """Measure over this number of photos, without the first batches, in which workers start."""
    files = _draw_photos(folder)
    places = [
        TrainingPlace(
            number, "city", tuple(files[(number * 4 + i) % DISTINCT_PHOTOS] for i in range(4))
        )
        for number in range(max(photos // PHOTOS_PER_PLACE, 4 * PLACES_PER_BATCH))
    ]
    bar = progress.add_task("photos per second", total=5)
    reading = {}
    for method, load in (
        ("decoded in full, one process", _decode_full),
        ("one process", _decode_draft),
    ):
        started_at = time.perf_counter()
        for file in files:
            load(file)
        reading[method] = len(files) / (time.perf_counter() - started_at)
        progress.advance(bar)
    batches = _batches(places, workers, device)
    reading["with its workers"], _ = _time_batches(batches, lambda batch: None, device)
    progress.advance(bar)
    step = _make_training_step(device)
    batch = next(_batches(places, workers, device))
    repeats = max(2, len(places) // PLACES_PER_BATCH // 2)
    network, _ = _time_batches([batch] * (repeats + WARM_UP_BATCHES), step, device)
    progress.advance(bar)
    training, waiting = _time_batches(_batches(places, workers, device), step, device)
    progress.advance(bar)
    return TrainingThroughput(reading, network, training, waiting)


def _draw_photos(folder: Path) -> list[Path]:
    folder.mkdir(parents=True)
    files = []
    for number in range(DISTINCT_PHOTOS):
        rng = np.random.default_rng(number)
        coarse = Image.fromarray(rng.integers(0, 255, (30, 40, 3)).astype(np.uint8))
        pixels = np.asarray(
            coarse.resize(STORED_PHOTO_SIZE[::-1], Image.Resampling.BICUBIC), np.int16
        )
        grain = rng.normal(0, 6, pixels.shape)  # so that a file has a photo's 300 to 500 kB
        path = folder / f"{number}.jpg"
        Image.fromarray(np.clip(pixels + grain, 0, 255).astype(np.uint8)).save(path, quality=90)
        files.append(path)
    return files


def _decode_full(path: Path) -> None:
    with Image.open(path) as image:
        small = image.convert("RGB").resize((IMAGE_PIXELS, IMAGE_PIXELS), Image.Resampling.BILINEAR)
    to_tensor(TRANSFORM.augment(small, 0))


def _decode_draft(path: Path) -> None:
    to_tensor(TRANSFORM.load(path, 0))


def _batches(places: list[TrainingPlace], workers: int, device: Device) -> Iterator[Batch]:
    sampler = PlaceBatchSampler(places, PLACES_PER_BATCH, PHOTOS_PER_PLACE, False, True, 1, 1)
    dataset = PlaceDataset(sampler, TRANSFORM, fail_on_undecodable=True)
    pin_memory = device.accelerator == "gpu"
    return load_batches(sampler, dataset, num_workers=workers, pin_memory=pin_memory)


def _make_training_step(device: Device) -> Callable[[Batch], None]:
    arguments = build_arguments(
        {"pretrained": False, "layers_to_freeze": -1, "agg_arch": "gem", "image_size": IMAGE_PIXELS}
    )
    torch.manual_seed(0)
    model = make_model(arguments, NullDisplay(), resuming=False).to(device.torch_device).train()
    loss, miner = make_loss("MultiSimilarityLoss"), make_miner("MultiSimilarityMiner")
    assert miner is not None
    optimizer = make_optimizer(model.parameters(), arguments)

    def step(batch: Batch) -> None:
        rows = model(batch.photos.to(device.torch_device, non_blocking=True))
        labels = batch.labels.to(device.torch_device, non_blocking=True)
        value = loss(rows, labels, miner(rows, labels))
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()

    return step


def _time_batches(
    batches: Iterable[Batch], step: Callable[[Batch], None], device: Device
) -> tuple[float, float]:
    """Return photos per second, and the share of the time spent waiting for batches."""
    iterator = iter(batches)
    for _ in range(WARM_UP_BATCHES):
        step(next(iterator))
    _synchronise(device)
    count, waited = 0, 0.0
    started_at = wait_started_at = time.perf_counter()
    for batch in iterator:
        waited += time.perf_counter() - wait_started_at
        step(batch)
        count += len(batch.photos)
        # The device has nothing to do from here until the next batch is there.
        _synchronise(device)
        wait_started_at = time.perf_counter()
    seconds = time.perf_counter() - started_at
    return count / seconds, waited / seconds


def _synchronise(device: Device) -> None:
    if device.accelerator == "gpu":
        torch.cuda.synchronize()
