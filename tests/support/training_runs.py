"""Training data drawn in a moment, and short runs of a small network on the CPU."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from services.trainer import run
from services.trainer.arguments import build_arguments
from services.trainer.run_control import NullDisplay, StopRequest

Json = dict[str, Any]


def run_arguments(places: Path, out: Path, **others: Any) -> Json:
    """A run of a small network: two epochs of three batches of two places."""
    return {
        "data_root": str(places),
        "accelerator": "cpu",
        "faiss_gpu": False,
        "pretrained": False,
        "layers_to_freeze": -1,
        "layers_to_crop": [2],
        "agg_arch": "gem",
        "image_size": 32,
        "batch_size": 2,
        "img_per_place": 3,
        "min_img_per_place": 3,
        "num_workers": 0,
        "max_epochs": 2,
        "warmpup_steps": 2,
        "lr": 1e-3,
        "log_every_n_steps": 1,
        "default_root_dir": str(out),
        "run_name": "run",
        "logger": "none",
        **others,
    }


def train(fields: Json, display: NullDisplay | None = None) -> Json:
    return run.run(build_arguments(fields), display or NullDisplay(), StopRequest())


def weights(path: Path) -> dict[str, torch.Tensor]:
    return dict(torch.load(path, weights_only=True)["state_dict"])


def assert_same_weights(one: Path, other: Path) -> None:
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


CITY = "smallville"
ZONE = "@32@T"
APART_M = 100.0


def write_tiny_places(
    root: Path, *, places: int = 6, photos: int = 4, side: int = 48, city: str = CITY
) -> Path:
    """gsv_xs below `root/gsv_xs`, and `root/database`, `root/queries` of other places."""
    train = root / "gsv_xs" / "train" / city
    rows = []
    for place in range(places):
        for number in range(photos):
            name = f"{_where(place)}@x@@@@@@@2024@{place}_{number}@.jpg"
            _draw(train / name, place, number, side)
            rows.append((place, city, f"{500_000 + place * APART_M:.2f}", "4880000.00", name))
    table = root / "gsv_xs" / "dataframes" / f"{city}.csv"
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([("place_id", "class_name", "UTMx", "UTMy", "filename"), *rows])
    for place in range(100, 100 + places):
        for folder, numbers in (("database", (0, 1)), ("queries", (2,))):
            for number in numbers:
                name = f"{_where(place)}@{place}_{number}@@@@@@@@@.jpg"
                _draw(root / folder / name, place, number, side)
    return root


def _where(place: int) -> str:
    return f"@{500_000 + place * APART_M:010.2f}@{4_880_000:010.2f}{ZONE}@@"


def _draw(path: Path, place: int, number: int, side: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(place).integers(0, 255, (6, 6, 3))
    own = np.random.default_rng((place, number)).integers(-30, 30, (6, 6, 3))
    pixels = np.clip(coarse + own, 0, 255).astype(np.uint8)
    Image.fromarray(pixels).resize((side, side), Image.Resampling.BICUBIC).save(path, quality=90)
