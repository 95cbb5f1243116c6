"""Checkpoints of place models: Lightning's `.ckpt`, which say themselves which network they hold.

    state_dict         tensors whose names begin with `model.`
    hyper_parameters   {"model": ModelConfig.model_dump(), ...}
    epoch, global_step, callbacks, ...     as Lightning writes them

They are read as `load_tensors` does: tensors and plain values; nothing in them is executed. The
network is laid out without memory first and then takes the file's own tensors, whose shapes are
compared with the file's size, so that a checkpoint can't ask for memory beyond its own bytes.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from shared.errors import NotFound, Unprocessable
from shared.vision.backbones.torchhub import weights_fingerprint
from shared.vision.place_models.config import ModelConfig
from shared.vision.place_models.model import PlaceModel, build_model
from shared.vision.place_models.predecessor import (
    MODEL_ARGUMENTS,
    is_predecessors,
    read_config,
    rename,
)
from shared.vision.tensor_files import UNREADABLE, check_promise, first_line, load_tensors

PREFIX = "model."
WITHOUT_EFFECT = {"pretrained", "layers_to_freeze"}  # on the descriptors of given weights


@dataclass(frozen=True, slots=True)
class Checkpoint:
    model: PlaceModel
    """On the CPU, in evaluation mode, without gradients."""
    config: ModelConfig
    """Of `model`, complete."""
    fingerprint: str
    """sha256 of all that decides a descriptor: the configuration and the weights."""
    about: dict[str, Any]
    """Where it comes from: `epoch`, `global_step`, and the hyperparameters beside the model's."""


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint of `placewise train` or of the predecessor's training, or what
    `checkpoint_state` gave to `torch.save`.

    Raises NotFound (`checkpoint_not_found`); Unprocessable: `checkpoint_unreadable` (no PyTorch
    file, a torn one, or one with more in it than tensors and plain values), `checkpoint_unfit`
    (another network's), and those of ModelConfig and `build_model`.
    """
    stored = _read(path)
    parameters, tensors = stored.get("hyper_parameters"), stored.get("state_dict")
    if not isinstance(parameters, Mapping) or not isinstance(tensors, Mapping):
        raise _unfit(path, "it has no hyper_parameters or no state_dict")
    if isinstance(parameters.get("model"), Mapping):
        config = ModelConfig.read({**parameters["model"], "pretrained": False})
        own = {n.removeprefix(PREFIX): t for n, t in tensors.items() if n.startswith(PREFIX)}
    elif is_predecessors(parameters):
        config = read_config(parameters)
        own = {rename(name): tensor for name, tensor in tensors.items()}
    else:
        raise _unfit(path, 'it has no hyper_parameters["model"]')
    with torch.device("meta"):
        model = build_model(config)
    _fill(model, own, path)
    model.eval().requires_grad_(False)
    beside = {"model", *MODEL_ARGUMENTS}
    about = {name: value for name, value in parameters.items() if name not in beside}
    about |= {name: stored[name] for name in ("epoch", "global_step") if name in stored}
    return Checkpoint(model, model.config, fingerprint(model), about)


def checkpoint_state(model: PlaceModel, **about: Any) -> dict[str, Any]:
    """What `torch.save` writes and `load_checkpoint` reads; `about` are further hyperparameters, of
    plain types."""
    return {
        "state_dict": {PREFIX + name: tensor for name, tensor in model.state_dict().items()},
        "hyper_parameters": {**about, "model": model.config.model_dump()},
    }


def fingerprint(model: PlaceModel) -> str:
    """sha256 of the configuration, as far as it has an effect, and of the weights."""
    said = model.config.model_dump(mode="json", exclude=WITHOUT_EFFECT)
    weights, _ = weights_fingerprint(model)
    return hashlib.sha256(f"{json.dumps(said, sort_keys=True)}\n{weights}".encode()).hexdigest()


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise NotFound("checkpoint_not_found", f"There is no checkpoint {path}.")
    try:
        stored = load_tensors(path)
    except UNREADABLE as error:
        raise Unprocessable(
            "checkpoint_unreadable",
            f"The checkpoint {path.name} can't be read as tensors and plain values, and nothing "
            f"else is loaded from one: {_reason(error)}",
        ) from error
    if not isinstance(stored, dict):
        raise _unfit(path, f"it holds a {type(stored).__name__}")
    return stored


def _reason(error: Exception) -> str:
    """torch's own words, without its advice to load the file as code."""
    refused = re.search(r"Unsupported [^\n]*?(?= was not|[\n]|$)", str(error))
    return refused[0] if refused else first_line(error)


def _fill(model: PlaceModel, tensors: dict[str, Any], path: Path) -> None:
    """Give the layout its tensors, every one in its shape and none besides."""
    wanted = model.state_dict()
    faults = [f"{name} is missing" for name in wanted if name not in tensors]
    faults += [f"{name} is of no layer" for name in tensors if name not in wanted]
    for name in wanted.keys() & tensors.keys():
        tensor, shape = tensors[name], tuple(wanted[name].shape)
        if not isinstance(tensor, torch.Tensor):
            faults.append(f"{name} is no tensor")
        elif tensor.is_meta or tensor.layout != torch.strided:
            faults.append(f"{name} is no dense tensor with numbers")
        elif tensor.shape != shape:
            faults.append(f"{name} is {tuple(tensor.shape)}, expected {shape}")
    if faults:
        more = f" and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise _unfit(path, "; ".join(faults[:3]) + more)
    try:
        check_promise((tensors[name] for name in wanted), path)
    except ValueError as error:
        raise _unfit(path, str(error)) from error
    # Copied, because they are mapped from the file, which may change.
    model.load_state_dict(
        {name: tensors[name].to(wanted[name].dtype, copy=True) for name in wanted}, assign=True
    )


def _unfit(path: Path, reason: str) -> Unprocessable:
    return Unprocessable(
        "checkpoint_unfit",
        f"{path.name} is no checkpoint of a place model: {reason}. `placewise train` writes them.",
    )
