"""Checkpoints of place models: Lightning's `.ckpt`, which say themselves which network they hold.

    state_dict         tensors whose names begin with `model.`
    hyper_parameters   {"model": ModelConfig.model_dump(), ...}
    epoch, global_step, callbacks, ...     as Lightning writes them

They are read as `load_tensors` does: tensors and plain values; nothing in them is executed. The
network is laid out without memory first and then takes the file's own tensors, whose shapes are
compared with the file's size, so that a checkpoint can't ask for memory beyond its own bytes.

The file in which a model that was added is kept: what describes a photo, and nothing else.

A `.safetensors` with the model's tensors by their names in `PlaceModel.state_dict()`, float32 as
they were trained, and one entry of metadata, `placewise_model`: JSON with

    format        1
    config        ModelConfig, complete
    fingerprint   as `checkpoint.fingerprint` says it

Reading one executes nothing and loads neither optimiser nor schedule; a checkpoint of Lightning's
is three times as large.
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
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from shared.descriptors.backbones.torchhub import module_fingerprint
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.gsv_compat import (
    GSV_MODEL_ARGUMENTS,
    is_gsv_checkpoint,
    read_gsv_config,
    rename_gsv_tensor,
)
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.descriptors.weight_files import (
    TENSOR_READ_ERRORS,
    check_promise,
    first_error_line,
    load_tensors,
)
from shared.errors import NotFound, PlacewiseError, Unavailable, Unprocessable

STATE_DICT_PREFIX = "model."
FIELDS_WITHOUT_EFFECT = {"pretrained", "layers_to_freeze"}  # on the descriptors of given weights


@dataclass(frozen=True, slots=True)
class Checkpoint:
    model: VprModel
    """On the CPU, in evaluation mode, without gradients."""
    config: VprModelConfig
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
    (another network's), and those of ModelConfig and `build_vpr_model`.
    """
    stored = _read(path)
    parameters, tensors = stored.get("hyper_parameters"), stored.get("state_dict")
    if not isinstance(parameters, Mapping) or not isinstance(tensors, Mapping):
        raise _checkpoint_unfit_error(path, "it has no hyper_parameters or no state_dict")
    if isinstance(parameters.get("model"), Mapping):
        config = VprModelConfig.parse({**parameters["model"], "pretrained": False})
        own = {
            n.removeprefix(STATE_DICT_PREFIX): t
            for n, t in tensors.items()
            if n.startswith(STATE_DICT_PREFIX)
        }
    elif is_gsv_checkpoint(parameters):
        config = read_gsv_config(parameters)
        own = {rename_gsv_tensor(name): tensor for name, tensor in tensors.items()}
    else:
        raise _checkpoint_unfit_error(path, 'it has no hyper_parameters["model"]')
    with torch.device("meta"):
        model = build_vpr_model(config)
    _fill(model, own, path)
    model.eval().requires_grad_(False)
    beside = {"model", *GSV_MODEL_ARGUMENTS}
    about = {name: value for name, value in parameters.items() if name not in beside}
    about |= {name: stored[name] for name in ("epoch", "global_step") if name in stored}
    return Checkpoint(model, model.config, model_fingerprint(model), about)


def checkpoint_state(model: VprModel, **about: Any) -> dict[str, Any]:
    """What `torch.save` writes and `load_checkpoint` reads; `about` are further hyperparameters, of
    plain types."""
    return {
        "state_dict": {
            STATE_DICT_PREFIX + name: tensor for name, tensor in model.state_dict().items()
        },
        "hyper_parameters": {**about, "model": model.config.model_dump()},
    }


def model_fingerprint(model: VprModel) -> str:
    """sha256 of the configuration, as far as it has an effect, and of the weights."""
    said = model.config.model_dump(mode="json", exclude=FIELDS_WITHOUT_EFFECT)
    weights, _ = module_fingerprint(model)
    return hashlib.sha256(f"{json.dumps(said, sort_keys=True)}\n{weights}".encode()).hexdigest()


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise NotFound("checkpoint_not_found", f"There is no checkpoint {path}.")
    try:
        stored = load_tensors(path)
    except TENSOR_READ_ERRORS as error:
        raise Unprocessable(
            "checkpoint_unreadable",
            f"The checkpoint {path.name} can't be read as tensors and plain values, and nothing "
            f"else is loaded from one: {_short_reason(error)}",
        ) from error
    if not isinstance(stored, dict):
        raise _checkpoint_unfit_error(path, f"it holds a {type(stored).__name__}")
    return stored


def _short_reason(error: Exception) -> str:
    """torch's own words, without its advice to load the file as code."""
    refused = re.search(r"Unsupported [^\n]*?(?= was not|[\n]|$)", str(error))
    return refused[0] if refused else first_error_line(error)


def _fill(model: VprModel, tensors: dict[str, Any], path: Path) -> None:
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
        raise _checkpoint_unfit_error(path, "; ".join(faults[:3]) + more)
    try:
        check_promise((tensors[name] for name in wanted), path)
    except ValueError as error:
        raise _checkpoint_unfit_error(path, str(error)) from error
    # Copied, because they are mapped from the file, which may change.
    model.load_state_dict(
        {name: tensors[name].to(wanted[name].dtype, copy=True) for name in wanted}, assign=True
    )


def _checkpoint_unfit_error(path: Path, reason: str) -> Unprocessable:
    return Unprocessable(
        "checkpoint_unfit",
        f"{path.name} is no checkpoint of a place model: {reason}. `placewise train` writes them.",
    )


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
