"""Training throughput: photos per second, and the share of time spent waiting for photos.

    placewise bench train [--photos 512] [--workers 2] [--device auto]

Times loading, the network alone, and both together, at 224 pixels: a ResNet-18 with GeM and
MultiSimilarityLoss, from random weights.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import typer
from PIL import Image

from lab.benchmarks.report import printed_report
from lab.datasets.dataset import TrainingPlace
from lab.training.arguments import build_arguments
from lab.training.data import (
    Batch,
    PhotoTransform,
    PlaceBatchSampler,
    PlaceDataset,
    load_batches,
    to_tensor,
)
from lab.training.losses import make_loss, make_miner
from lab.training.model_factory import make_model
from lab.training.resolve import make_fabric
from lab.training.run_control import NullDisplay
from lab.training.training_loop import make_optimizer
from services.cli.output import JsonOption

MAX_WAIT_SHARE = 0.05
"""on a GPU"""
IMAGE_PIXELS = 224
TRANSFORM = PhotoTransform((IMAGE_PIXELS, IMAGE_PIXELS))
STORED_PHOTO_SIZE = (960, 1280)
"""height and width of a photo as cameras and street view give them"""
DISTINCT_PHOTOS = 32
"""number of generated photos; they are read repeatedly, from the page cache"""
PHOTOS_PER_PLACE = 4
PLACES_PER_BATCH = 8
WARM_UP_BATCHES = 2


def bench(
    photos: Annotated[int, typer.Option(min=64)] = 512,
    workers: Annotated[int, typer.Option(min=1, help="Data loader processes.")] = 2,
    device: Annotated[Literal["auto", "cpu", "gpu", "mps"], typer.Option(help="Device.")] = "auto",
    as_json: JsonOption = False,
) -> None:
    """Measure training throughput and how long the network waits for photos."""
    chosen = make_fabric(build_arguments({"accelerator": device})).device
    title = f"training on {chosen.type}"
    with (
        printed_report(title, as_json) as (report, progress),
        tempfile.TemporaryDirectory(prefix="placewise-bench-") as folder,
    ):
        bar = progress.add_task("photos per second", total=5)
        files = _draw_photos(Path(folder))
        # Without the first batches, in which workers start.
        places = [
            TrainingPlace(
                number, "city", tuple(files[(number * 4 + i) % DISTINCT_PHOTOS] for i in range(4))
            )
            for number in range(max(photos // PHOTOS_PER_PLACE, 4 * PLACES_PER_BATCH))
        ]
        for method, load in (
            ("decoded in full, one process", _decode_full),
            ("one process", _decode_draft),
        ):
            started_at = time.perf_counter()
            for file in files:
                load(file)
            rate = len(files) / (time.perf_counter() - started_at)
            report.add(f"photos read to 224 pixels: {method}", rate, "photos/s")
            progress.advance(bar)
        reading, _ = _time_batches(_batches(places, workers, chosen), lambda batch: None, chosen)
        report.add("photos read to 224 pixels: with its workers", reading, "photos/s")
        progress.advance(bar)
        step = _make_training_step(chosen)
        batch = next(_batches(places, workers, chosen))
        repeats = max(2, len(places) // PLACES_PER_BATCH // 2)
        network, _ = _time_batches([batch] * (repeats + WARM_UP_BATCHES), step, chosen)
        report.add("photos that the network learns from", network, "photos/s")
        progress.advance(bar)
        training, waiting = _time_batches(_batches(places, workers, chosen), step, chosen)
        report.add("photos learned from, reading included", training, "photos/s")
        report.add(
            "share of the time waiting for photos",
            waiting,
            at_most=MAX_WAIT_SHARE if chosen.type == "cuda" else None,
        )
        report.add("reading, as a multiple of the network's pace", reading / network, at_least=1.0)
        report.details = {"torch": torch.__version__}
        progress.advance(bar)


def _draw_photos(folder: Path) -> list[Path]:
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


def _batches(places: list[TrainingPlace], workers: int, device: torch.device) -> Iterator[Batch]:
    sampler = PlaceBatchSampler(places, PLACES_PER_BATCH, PHOTOS_PER_PLACE, False, True, 1, 1)
    dataset = PlaceDataset(sampler, TRANSFORM, fail_on_undecodable=True)
    pin_memory = device.type == "cuda"
    return load_batches(sampler, dataset, num_workers=workers, pin_memory=pin_memory)


def _make_training_step(device: torch.device) -> Callable[[Batch], None]:
    arguments = build_arguments(
        {"pretrained": False, "layers_to_freeze": -1, "agg_arch": "gem", "image_size": IMAGE_PIXELS}
    )
    torch.manual_seed(0)
    model = make_model(arguments, NullDisplay(), resuming=False).to(device).train()
    loss, miner = make_loss("MultiSimilarityLoss"), make_miner("MultiSimilarityMiner")
    assert miner is not None
    optimizer = make_optimizer(model.parameters(), arguments)

    def step(batch: Batch) -> None:
        rows = model(batch.photos.to(device, non_blocking=True))
        labels = batch.labels.to(device, non_blocking=True)
        value = loss(rows, labels, miner(rows, labels))
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()

    return step


def _time_batches(
    batches: Iterable[Batch], step: Callable[[Batch], None], device: torch.device
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


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()
