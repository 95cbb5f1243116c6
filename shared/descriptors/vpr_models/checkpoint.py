"""Checkpoints and model files of VPR models.

A checkpoint has the keys of PyTorch Lightning's `.ckpt`, and describes its own network:

    state_dict         tensors whose names begin with `model.`
    hyper_parameters   {"model": VprModelConfig.model_dump(), ...}
    epoch, global_step, ...     of the training; `last.ckpt` also holds the optimizer's state

It is read with `load_tensors`: tensors and plain values only, and no code is executed. The network
is built on the `meta` device first and then takes the file's own tensors, whose shapes are compared
with the file's size, so that a checkpoint can't allocate more memory than its own bytes.

A model file stores a registered model for inference: a `.safetensors` with the model's tensors by
their names in `VprModel.state_dict()`, float32 as they were trained, and one metadata entry,
`placewise_model`, JSON with

    format        1
    config        VprModelConfig, complete
    fingerprint   `model_fingerprint` of the model

It has no optimizer state; `last.ckpt` is three times as large.
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
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.descriptors.vpr_models.published_checkpoints import (
    GSV_MODEL_ARGUMENTS,
    read_published_checkpoint,
)
from shared.descriptors.weight_files import (
    TENSOR_READ_ERRORS,
    check_declared_size,
    is_safetensors,
    load_tensors,
    open_tensor_file,
    shape_differences,
)
from shared.errors import NotFound, PlacewiseError, Unavailable, Unprocessable

STATE_DICT_PREFIX = "model."
STATE_DICT_NAMES = ("state_dict", "model_state_dict", "model")
"""Entries of a checkpoint that hold the network's tensors"""
FIELDS_WITHOUT_EFFECT = {"pretrained", "layers_to_freeze"}  # for loaded weights


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A loaded checkpoint."""

    model: VprModel
    """On the CPU, in evaluation mode, without gradients."""
    config: VprModelConfig
    """The complete configuration of `model`."""
    fingerprint: str
    """`model_fingerprint` of `model`."""
    about: dict[str, Any]
    """Provenance: `epoch`, `global_step` and the training's hyperparameters."""


def load_checkpoint(path: Path) -> Checkpoint:
    """Load a checkpoint of `placewise train`, or one that `published_checkpoints` reads.

    Raises:
        NotFound: `checkpoint_not_found`.
        Unprocessable: `checkpoint_unreadable` (not a PyTorch file, truncated, or with other objects
            than tensors and plain values); `checkpoint_unusable` (tensors of another network); and
            as VprModelConfig and `build_vpr_model`.
    """
    stored = _read(path)
    parameters = stored.get("hyper_parameters", {})
    tensors = _find_tensors(stored, path)
    if not isinstance(parameters, Mapping):
        raise _checkpoint_unusable_error(path, "its hyper_parameters are no mapping")
    if isinstance(parameters.get("model"), Mapping):
        config = VprModelConfig.parse({**parameters["model"], "pretrained": False})
        own_tensors = {
            n.removeprefix(STATE_DICT_PREFIX): t
            for n, t in tensors.items()
            if n.startswith(STATE_DICT_PREFIX)
        }
    else:
        try:
            config, own_tensors = read_published_checkpoint(parameters, tensors)
        except ValueError as error:
            raise _checkpoint_unusable_error(path, str(error)) from error
    with torch.device("meta"):
        model = build_vpr_model(config)
    _load_tensors_into(model, own_tensors, path)
    model.eval().requires_grad_(False)
    model_fields = {"model", *GSV_MODEL_ARGUMENTS}
    about = {name: value for name, value in parameters.items() if name not in model_fields}
    about |= {name: stored[name] for name in ("epoch", "global_step") if name in stored}
    return Checkpoint(model, model.config, model_fingerprint(model), about)


def checkpoint_state(model: VprModel, **about: Any) -> dict[str, Any]:
    """Return the checkpoint of a model, for `torch.save`; `load_checkpoint` reads it.

    `about`: further hyperparameters, of plain types.
    """
    return {
        "state_dict": {
            STATE_DICT_PREFIX + name: tensor for name, tensor in model.state_dict().items()
        },
        "hyper_parameters": {**about, "model": model.config.model_dump()},
    }


def model_fingerprint(model: VprModel) -> str:
    """Return the sha256 of the weights and the configuration fields that affect descriptors."""
    config = model.config.model_dump(mode="json", exclude=FIELDS_WITHOUT_EFFECT)
    weights, _ = module_fingerprint(model)
    return hashlib.sha256(f"{json.dumps(config, sort_keys=True)}\n{weights}".encode()).hexdigest()


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise NotFound("checkpoint_not_found", f"There is no checkpoint {path}.")
    try:
        if is_safetensors(path):
            file = open_tensor_file(path)
            return {name: file.read(name) for name in file.shapes}
        stored = load_tensors(path)
    except TENSOR_READ_ERRORS as error:
        raise Unprocessable(
            "checkpoint_unreadable",
            f"The checkpoint {path.name} can't be read: it was not written by torch.save, is "
            f"truncated, or has other objects than tensors and plain values{_known_reason(error)}.",
        ) from error
    if not isinstance(stored, dict):
        raise _checkpoint_unusable_error(path, f"it holds a {type(stored).__name__}")
    return stored


def _find_tensors(stored: dict[str, Any], path: Path) -> Mapping[str, Any]:
    """Return the named tensors of a file, which may be an entry of it beside others."""

    def holds_tensors(entry: Any) -> bool:
        return isinstance(entry, Mapping) and any(
            isinstance(value, torch.Tensor) for value in entry.values()
        )

    found: dict[str, Mapping[str, Any]] = {
        name: entry for name, entry in stored.items() if holds_tensors(entry)
    }
    for name in STATE_DICT_NAMES:
        if name in found:
            return found[name]
    if holds_tensors(stored):
        return stored
    if len(found) != 1:
        names = ", ".join(f"{name!s:.60}" for name in found or stored) or "nothing"
        raise _checkpoint_unusable_error(
            path, f"{len(found)} of its entries hold tensors, and one should ({names})"
        )
    return next(iter(found.values()))


def _known_reason(error: Exception) -> str:
    """Return, in parentheses, the object that torch refuses, or what `load_tensors` found."""
    refused = re.search(r"Unsupported (?:global|class|type)[^\n]*?(?= was not|[\n]|$)", str(error))
    reason = refused[0] if refused else str(error) if type(error) is ValueError else ""
    return reason and f" ({reason})"


def _load_tensors_into(model: VprModel, tensors: dict[str, Any], path: Path) -> None:
    """Load exactly the model's tensors, after checking names, types and shapes."""
    expected = model.state_dict()
    unusable = [
        name
        for name, tensor in tensors.items()
        if not isinstance(tensor, torch.Tensor) or tensor.is_meta or tensor.layout != torch.strided
    ]
    if unusable:
        raise _checkpoint_unusable_error(path, f"{unusable[0]} is not a dense tensor with data")
    stored, shapes = (
        {name: tuple(tensor.shape) for name, tensor in each.items()} for each in (tensors, expected)
    )
    if differences := shape_differences(stored, shapes):
        raise _checkpoint_unusable_error(path, differences)
    try:
        check_declared_size((tensors[name] for name in expected), path)
    except ValueError as error:
        raise _checkpoint_unusable_error(path, str(error)) from error
    # Copied, because they are mapped from the file, which may change.
    model.load_state_dict(
        {name: tensors[name].to(expected[name].dtype, copy=True) for name in expected}, assign=True
    )


def _checkpoint_unusable_error(path: Path, reason: str) -> Unprocessable:
    return Unprocessable(
        "checkpoint_unusable",
        f"{path.name} is not a checkpoint of a known VPR model: {reason}. Use one of `placewise "
        "train`, or of a network in docs/place-models.md. Other networks work without a checkpoint "
        "if their authors publish a hubconf.py, as the extractor torchhub:OWNER/NAME@COMMIT:ENTRY:"
        "input.size=HEIGHTxWIDTH (docs/how-to/weights-and-other-engines.md).",
    )


METADATA_KEY = "placewise_model"
MODEL_FILE_FORMAT = 1


def encode_model_file(checkpoint: Checkpoint) -> bytes:
    """Encode a model file; deterministic for the same configuration and weights."""
    about = {
        "format": MODEL_FILE_FORMAT,
        "config": checkpoint.config.model_dump(mode="json"),
        "fingerprint": checkpoint.fingerprint,
    }
    # Copied: safetensors can't write views and tensors that share memory.
    tensors = {
        name: tensor.detach().clone(memory_format=torch.contiguous_format)
        for name, tensor in checkpoint.model.state_dict().items()
    }
    return save(tensors, {METADATA_KEY: json.dumps(about, sort_keys=True)})


def read_model_file(path: Path) -> VprModel:
    """Load a model file on the CPU, in evaluation mode; the caller has verified its hash.

    Raises Unavailable (`model_unreadable`) if this release does not know the format, or can no
    longer build the network.
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
    return model.eval().requires_grad_(False)


def _unreadable(path: Path, reason: str) -> Unavailable:
    return Unavailable(
        "model_unreadable",
        f"The model in {path.name} can't be built by this release: {reason.splitlines()[0]}. Run "
        "the release that registered it, or a newer one.",
    )
