"""The file in which a model that was added is kept: what describes a photo, and nothing else.

A `.safetensors` with the model's tensors by their names in `PlaceModel.state_dict()`, float32 as
they were trained, and one entry of metadata, `placewise_model`: JSON with

    format        1
    config        ModelConfig, complete
    fingerprint   as `checkpoint.fingerprint` says it

Reading one executes nothing and loads neither optimiser nor schedule; a checkpoint of Lightning's
is three times as large.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from shared.errors import PlacewiseError, Unavailable
from shared.vision.place_models.checkpoint import Checkpoint
from shared.vision.place_models.config import VprModelConfig
from shared.vision.place_models.model import VprModel, build_vpr_model

METADATA_KEY = "placewise_model"
MODEL_FILE_FORMAT = 1


@dataclass(frozen=True, slots=True)
class ModelFile:
    model: VprModel
    """On the CPU, in evaluation mode, without gradients."""
    fingerprint: str


def encode_model_file(checkpoint: Checkpoint) -> bytes:
    """The file's bytes; the same for the same configuration and weights."""
    about = {
        "format": MODEL_FILE_FORMAT,
        "config": checkpoint.config.model_dump(mode="json"),
        "fingerprint": checkpoint.fingerprint,
    }
    # Copied: a tensor that is a view of another, or shares its memory, can't be written.
    tensors = {
        name: tensor.detach().clone(memory_format=torch.contiguous_format)
        for name, tensor in checkpoint.model.state_dict().items()
    }
    return save(tensors, {METADATA_KEY: json.dumps(about, sort_keys=True)})


def read_model_file(path: Path) -> ModelFile:
    """The model in a file whose hash was checked.

    Unavailable (`model_unreadable`): this release does not know the format, or no longer builds
    the network.
    """
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {})[METADATA_KEY])
            if about["format"] != MODEL_FILE_FORMAT:
                raise _unreadable(path, f"its format is {about['format']}, not {MODEL_FILE_FORMAT}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        config = VprModelConfig.parse({**about["config"], "pretrained": False})
        with torch.device("meta"):
            model = build_vpr_model(config)
        model.load_state_dict(tensors, assign=True)
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise _unreadable(path, str(error) or type(error).__name__) from error
    except PlacewiseError as error:
        if isinstance(error, Unavailable):
            raise
        raise _unreadable(path, error.detail) from error
    return ModelFile(model.eval().requires_grad_(False), about["fingerprint"])


def _unreadable(path: Path, reason: str) -> Unavailable:
    return Unavailable(
        "model_unreadable",
        f"The model in {path.name} can't be built by this release: {reason.splitlines()[0]}. Run "
        "the release that it was added with, or a newer one.",
    )
