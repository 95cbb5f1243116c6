"""Training data drawn in a moment, and short runs of a small network on the CPU."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from lab.training import run
from lab.training.arguments import build_arguments
from lab.training.run_control import NullDisplay, StopRequest

Json = dict[str, Any]

# As the predecessor's README prints it; only the program's name is another.
PUBLISHED_COMMAND = r"""
   --batch_size 100 --img_per_place 4 --min_img_per_place 4 --shuffle_all False
   --random_sample_from_each_place True --image_size "(320, 320)" --num_workers 8
   --show_data_stats True --val_set_names '["sfxs_val"]'
   --test_set_names '["sfxs_test", "tokyoxs_test"]' --backbone_arch "resnet18" --pretrained True
   --layers_to_freeze -1 --layers_to_crop '[4]' --agg_arch "Gem" --agg_config '{"p":3}'
   --lr 0.0002 --optimizer "adam" --weight_decay 0 --momentum 0.9 --warmpup_steps 600
   --milestones '[5, 10, 15, 25]' --lr_mult 0.3 --loss_name "MultiSimilarityLoss"
   --miner_name "BatchHardMiner" --miner_margin 0.1 --faiss_gpu True --monitor "sfxs_val/R1"
   --filename "{self.backbone_arch}\_epoch({epoch:02d})\_step({step:04d})\_R1[{pitts30k_val/R1:.4f}]\_R5[{sfxs_val/R5:.4f}]"
   --auto_insert_metric_name False --save_weights_only True --save_top_k 3 --mode "max"
   --accelerator "gpu" --devices 1 --default_root_dir "./LOGS/{self.backbone_arch}"
   --num_sanity_val_steps 0 --precision 32 --max_epochs 8 --check_val_every_n_epoch 1
   --reload_dataloaders_every_n_epochs 1 --log_every_n_steps 20 --fast_dev_run False
   --model_path '' --experiment_phase "train"
"""  # noqa: E501


def run_arguments(places: Path, out: Path, **others: Any) -> Json:
    """A run of a small network: two epochs of three batches of two places."""
    return {
        "data_root": str(places),
        "accelerator": "cpu",
        "faiss_gpu": False,
        "backbone_arch": "resnet18",
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


def write_tiny_places(root: Path, *, places: int = 6, light: float = 0.0) -> Path:
    """gsv_xs below `root/gsv_xs`, and `root/database`, `root/queries` of other places.

    Each photo is taken in light of its own colour: red, green and blue lose up to this share.
    """
    train = root / "gsv_xs" / "train" / CITY
    rows = []
    for place in range(places):
        for number in range(4):
            name = f"{_where(place)}@x@@@@@@@2024@{place}_{number}@.jpg"
            _draw(train / name, place, number, light)
            rows.append((place, CITY, f"{500_000 + place * APART_M:.2f}", "4880000.00", name))
    table = root / "gsv_xs" / "dataframes" / f"{CITY}.csv"
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([("place_id", "class_name", "UTMx", "UTMy", "filename"), *rows])
    for place in range(100, 100 + places):
        for folder, numbers in (("database", (0, 1)), ("queries", (2,))):
            for number in numbers:
                name = f"{_where(place)}@{place}_{number}@@@@@@@@@.jpg"
                _draw(root / folder / name, place, number, light)
    return root


def _where(place: int) -> str:
    return f"@{500_000 + place * APART_M:010.2f}@{4_880_000:010.2f}{ZONE}@@"


def _draw(path: Path, place: int, number: int, light: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(place).integers(0, 255, (6, 6, 3))
    rng = np.random.default_rng((place, number))
    own = rng.integers(-30, 30, (6, 6, 3))
    colour = 1 - light * rng.random(3)
    pixels = np.clip((coarse + own) * colour, 0, 255).astype(np.uint8)
    Image.fromarray(pixels).resize((48, 48), Image.Resampling.BICUBIC).save(path, quality=90)


class StopAfter(NullDisplay):
    """Requests a stop at the `times`-th report of progress in `what`."""

    def __init__(self, stop: StopRequest, what: str, times: int) -> None:
        super().__init__()
        self._stop, self._what, self._left = stop, what, times

    def progress(self, what: str, done: int, total: int, note: str = "") -> None:
        if what.startswith(self._what):
            self._left -= 1
            if self._left == 0:
                self._stop.is_requested = True
