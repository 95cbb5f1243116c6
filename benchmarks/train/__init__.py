"""Training: photos per second, share of time spent waiting for photos, and recall gained.

    placewise bench train [--places 300] [--epochs 20] [--image-size 112] [--device auto]

`throughput` times loading, the network alone, and both together, at 224 pixels. `learning` trains a
ResNet-18 with GeM from random weights on a generated city, and reports R@1 (25 m rule) of the
untrained and of the trained network on other streets of that city and on a city of another style,
with the 95 % interval of the difference.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from benchmarks.report import Report
from benchmarks.train.learning import measure_learning
from benchmarks.train.throughput import measure_throughput
from services.trainer.arguments import build_arguments
from services.trainer.resolve import resolve_device

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
        pace = measure_throughput(progress, out / "pace", photos, workers, chosen)
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
        learnt = measure_learning(progress, out, places, epochs, image_size, workers, chosen, seed)
        for where, gain in learnt.items():
            report.add(f"R@1 untrained, {where}", 100 * gain.untrained, "%")
            report.add(f"R@1 trained, {where}", 100 * gain.trained, "%")
            report.add(f"points gained, {where}", 100 * gain.mean, "points", at_least=TARGET_POINTS)
            report.add(f"points gained at least (95 %), {where}", 100 * gain.low, "points")
        report.details = {
            "torch": torch.__version__,
            "learning": {where: gain.as_json() for where, gain in learnt.items()},
            "seed": seed,
        }
    return report
