"""Checkpoints as `placewise train` writes them, of networks that nobody has trained."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import torch

from shared.descriptors.backbones import normalise_pixels
from shared.descriptors.vpr_models.checkpoint import checkpoint_state
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.extractor_config.configs import ExtractorConfig
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing
from shared.storage.chunks import Rows

SIDES = (48, 64)  # pixels
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def untrained(seed: int = 0, **config: Any) -> VprModel:
    """A cropped ResNet-18 with random weights: 128 dimensions, photos of SIDES."""
    fields: dict[str, Any] = {
        "backbone_arch": "resnet18",
        "pretrained": False,
        "layers_to_crop": (3, 4),
        "agg_arch": "GeM",
        "image_size": SIDES,
        **config,
    }
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return build_vpr_model(VprModelConfig(**fields))


def checkpoint_of(model: VprModel, **about: Any) -> bytes:
    """A Lightning checkpoint of the model: beside the weights, what a run goes on with."""
    moments = {name: torch.zeros_like(tensor) for name, tensor in model.state_dict().items()}
    state = {
        **checkpoint_state(model, lr=0.0001, **about),
        "epoch": 3,
        "global_step": 120,
        "optimizer_states": [{"state": {"exp_avg": moments}}],
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


@cache
def some_checkpoint(seed: int = 0) -> bytes:
    """One of each seed."""
    return checkpoint_of(untrained(seed))


def write_checkpoint(path: Path) -> Path:
    path.write_bytes(some_checkpoint())
    return path


def own_output(model: VprModel, photo: bytes) -> Rows:
    """What the model itself makes of a photo that is brought to its size."""
    height, width = model.config.image_size
    preprocessing = get_preprocessing(f"resize{height}x{width}")
    pixels = decode_photo(photo, preprocessing, 10**9).pixels.copy()
    with torch.inference_mode():
        batch = normalise_pixels(torch.from_numpy(pixels)[None], MEAN, STD)
        row: Rows = model(batch)[0].numpy()
    return row


def none_added(config: ExtractorConfig, device: torch.device) -> NoReturn:
    raise AssertionError(f"nothing in this test names the model {config.name}")
