"""Training throughput: photos loaded and trained on per second, share of time spent waiting."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image

from services.trainer.arguments import build_arguments
from services.trainer.data import (
    Batch,
    PlaceBatchSampler,
    PlaceDataset,
    apply_randaugment,
    load_batches,
    to_tensor,
)
from services.trainer.losses import make_loss
from services.trainer.miners import make_miner
from services.trainer.model_factory import make_model
from services.trainer.resolve import Device
from services.trainer.run_control import NullDisplay
from services.trainer.training_loop import make_optimizer
from shared.datasets.dataset import TrainingPlace
from shared.imaging.decode import decode_resized

if TYPE_CHECKING:
    from rich.progress import Progress

IMAGE_PIXELS = 224
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


def measure_throughput(
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
    bar = progress.add_task("photos a second", total=4)
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
    reading["with its workers"] = _measure_reading(_batches(places, workers, device))
    progress.advance(bar)
    network, training, waited = _measure_training(places, workers, device)
    progress.advance(bar)
    return TrainingThroughput(reading, network, training, waited)


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
    to_tensor(apply_randaugment(small, 0))


def _decode_draft(path: Path) -> None:
    to_tensor(apply_randaugment(decode_resized(path, (IMAGE_PIXELS, IMAGE_PIXELS)), 0))


def _batches(places: list[TrainingPlace], workers: int, device: Device) -> Iterator[Batch]:
    sampler = PlaceBatchSampler(places, PLACES_PER_BATCH, PHOTOS_PER_PLACE, False, True, 1, 1)
    dataset = PlaceDataset(sampler, (IMAGE_PIXELS, IMAGE_PIXELS), fail_on_undecodable=True)
    pin_memory = device.accelerator == "gpu"
    return load_batches(sampler, dataset, num_workers=workers, pin_memory=pin_memory)


def _measure_reading(batches: Iterator[Batch]) -> float:
    for _ in range(WARM_UP_BATCHES):
        next(batches)
    started_at, count = time.perf_counter(), 0
    for batch in batches:
        count += len(batch.photos)
    return count / (time.perf_counter() - started_at)


def _measure_training(
    places: list[TrainingPlace], workers: int, device: Device
) -> tuple[float, float, float]:
    arguments = build_arguments(
        {"pretrained": False, "layers_to_freeze": -1, "agg_arch": "gem", "image_size": IMAGE_PIXELS}
    )
    torch.manual_seed(0)
    model = make_model(arguments, NullDisplay(), resuming=False).to(device.torch_device).train()
    loss, miner = make_loss("MultiSimilarityLoss"), make_miner("MultiSimilarityMiner")
    assert miner is not None
    optimizer = make_optimizer(model.parameters(), arguments)
    batches = _batches(places, workers, device)

    def step(photos: torch.Tensor, labels: torch.Tensor) -> None:
        rows = model(photos.to(device.torch_device, non_blocking=True))
        labels = labels.to(device.torch_device, non_blocking=True)
        value = loss(rows, labels, miner(rows, labels))
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()

    for _ in range(WARM_UP_BATCHES):
        batch = next(batches)
        step(batch.photos, batch.labels)
    repeats = max(2, (len(places) // PLACES_PER_BATCH - WARM_UP_BATCHES) // 2)
    _synchronise(device)
    started_at = time.perf_counter()
    for _ in range(repeats):
        step(batch.photos, batch.labels)
    _synchronise(device)
    network = repeats * len(batch.photos) / (time.perf_counter() - started_at)
    batches = _batches(places, workers, device)
    for _ in range(WARM_UP_BATCHES):
        batch = next(batches)
        step(batch.photos, batch.labels)
    count, waited = 0, 0.0
    _synchronise(device)
    started_at = wait_started_at = time.perf_counter()
    for batch in batches:
        waited += time.perf_counter() - wait_started_at
        step(batch.photos, batch.labels)
        count += len(batch.photos)
        # The device has nothing to do from here until the next batch is there.
        _synchronise(device)
        wait_started_at = time.perf_counter()
    seconds = time.perf_counter() - started_at
    return network, count / seconds, waited / seconds


def _synchronise(device: Device) -> None:
    if device.accelerator == "gpu":
        torch.cuda.synchronize()
