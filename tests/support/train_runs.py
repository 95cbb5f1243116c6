"""Runs of a small network on tiny places, on the processor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from services.trainer import run
from services.trainer.arguments import build_arguments
from services.trainer.run_control import NullDisplay, StopRequest

Json = dict[str, Any]


def told(places: Path, out: Path, **others: Any) -> Json:
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


def train(said: Json, display: NullDisplay | None = None) -> Json:
    return run.run(build_arguments(said), display or NullDisplay(), StopRequest())


def weights(path: Path) -> dict[str, torch.Tensor]:
    return dict(torch.load(path, weights_only=True)["state_dict"])


def assert_same_weights(one: Path, other: Path) -> None:
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name
