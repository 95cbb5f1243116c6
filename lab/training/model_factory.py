"""Creates the network of a run: pretrained weights, those of a checkpoint, or random weights.

Backbones, aggregators, losses and miners of the user are named `package.module:Name` in the
arguments. Importing them executes code, so only the arguments of a run do that, never a checkpoint:
a checkpoint of such a network is loaded while its names are registered, and is an error elsewhere.
"""

from __future__ import annotations

import importlib
import json
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lab.training.arguments import TrainingArguments
from lab.training.run_control import Display
from shared.descriptors.aggregators import AGGREGATORS
from shared.descriptors.aggregators.base import Aggregator
from shared.descriptors.vpr_models.backbones import register_backbone
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.config import VprModelConfig, is_own_module
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.descriptors.weight_files import TENSOR_READ_ERRORS, load_tensors
from shared.errors import Conflict, InvalidRequest, Misconfigured


def build_model_config(arguments: TrainingArguments) -> VprModelConfig:
    """Build the model configuration from the arguments; raises what `VprModelConfig.parse` does."""
    return VprModelConfig.parse(
        {name: getattr(arguments, name) for name in VprModelConfig.model_fields}
        | {"image_size": arguments.evaluation_size}
    )


def make_model(arguments: TrainingArguments, display: Display, *, resuming: bool) -> VprModel:
    """Create the network with pretrained weights, those of a checkpoint, or random weights.

    Random weights depend on the global seed. With `resuming`, the weights are loaded later, from
    the run's checkpoint. Raises Conflict (`run_differs`) if the checkpoint's network differs from
    the arguments', and what `build_vpr_model` and `load_checkpoint` raise.
    """
    config = build_model_config(arguments)
    checkpoint = _initial_checkpoint(arguments)
    if resuming or checkpoint is not None:
        model = build_vpr_model(config.model_copy(update={"pretrained": False}))
        model.config = model.config.model_copy(update={"pretrained": config.pretrained})
        if checkpoint is not None and not resuming:
            initial = load_checkpoint(checkpoint).model
            _check_same_network(checkpoint, initial.config, model.config)
            if initial.config.interpolation != config.interpolation:
                display.warn(
                    f"The weights of {checkpoint} belong to photos that are resized with "
                    f"--interpolation {initial.config.interpolation}; this run resizes them with "
                    f"{config.interpolation}."
                )
            model.load_state_dict(initial.state_dict())
        return model
    if not config.pretrained and config.layers_to_freeze >= 0:
        display.warn(
            f"--layers_to_freeze {config.layers_to_freeze} freezes layers whose weights are random "
            "(--pretrained False): they never learn. Use --layers_to_freeze -1 to train them."
        )
    return _build_pretrained_model(config, arguments.weights)


_missing_weights: dict[tuple[str, str], str] = {}
"""Details of `weights_missing`, by backbone and torch.hub's folder"""


def _build_pretrained_model(config: VprModelConfig, weights: Path | None) -> VprModel:
    """Build the network; a failed download, which takes minutes, is not repeated."""
    key = config.backbone_arch, torch.hub.get_dir()
    if config.pretrained and weights is None and key in _missing_weights:
        raise Misconfigured("weights_missing", _missing_weights[key])
    try:
        return build_vpr_model(config, weights=weights)
    except Misconfigured as error:
        if error.code == "weights_missing" and weights is None:
            _missing_weights[key] = error.detail
        raise


def _initial_checkpoint(arguments: TrainingArguments) -> Path | None:
    """Return `model_path`, or `weights` if they are those of a complete network."""
    if arguments.model_path is not None:
        return arguments.model_path
    weights = arguments.weights if arguments.pretrained else None
    return weights if weights is not None and _is_checkpoint(weights) else None


def _is_checkpoint(path: Path) -> bool:
    """Whether a file has the tensors of a VPR model, and not those of a backbone alone."""
    try:
        stored = load_tensors(path)
    except TENSOR_READ_ERRORS:
        return False
    return isinstance(stored, Mapping) and (
        not {"state_dict", "model_state_dict"}.isdisjoint(stored)
        or any(str(name).startswith("backbone.") for name in stored)
    )


def _check_same_network(path: Path, stored: VprModelConfig, described: VprModelConfig) -> None:
    expected = _describe_network(described)
    values = [
        (name, getattr(stored, name))
        for name, value in _describe_network(stored).items()
        if value != expected[name]
    ]
    if values:
        raise Conflict(
            "run_differs",
            f"The network of the checkpoint {path} differs from the one that the arguments "
            "describe. To train it, pass "
            + " ".join(
                f"--{name} {shlex.quote(value if isinstance(value, str) else json.dumps(value))}"
                for name, value in values
            ),
        )


def _describe_network(config: VprModelConfig) -> dict[str, object]:
    """Return what decides the tensors; the size of photos does so for MixVPR only."""
    return {
        "backbone_arch": config.backbone_arch,
        "layers_to_crop": config.stages,
        "backbone_norm": config.backbone_norm,
        "agg_arch": config.agg_arch,
        "agg_config": config.agg_config,
        "image_size": config.image_size if config.agg_arch == "MixVPR" else None,
    }


def register_own_modules(arguments: TrainingArguments) -> None:
    """Import the backbone and the aggregator that the arguments name by module path.

    Raises:
        InvalidRequest: `own_module_unusable`, if one can't be imported or is not what it should be.
    """
    if is_own_module(arguments.backbone_arch):
        build: Callable[[bool], nn.Module] = _import_object(
            "backbone_arch", arguments.backbone_arch
        )
        register_backbone(arguments.backbone_arch, build)
    if is_own_module(arguments.agg_arch):
        aggregator = _import_object("agg_arch", arguments.agg_arch)
        if not (isinstance(aggregator, type) and issubclass(aggregator, Aggregator)):
            raise _unusable_error(
                "agg_arch",
                arguments.agg_arch,
                "it is not a subclass of Aggregator (shared.descriptors.aggregators.base)",
            )
        AGGREGATORS[arguments.agg_arch] = aggregator


def make_own_module(argument: str, path: str) -> nn.Module:
    """Create a loss or miner of the user by calling what `path` names, without arguments.

    Raises InvalidRequest: `own_module_unusable`; also for a module with parameters, because the
    optimizer trains those of the network only.
    """
    try:
        made = _import_object(argument, path)()
    except TypeError as error:
        raise _unusable_error(argument, path, str(error)) from error
    if not isinstance(made, nn.Module):
        raise _unusable_error(argument, path, "it does not make a torch.nn.Module")
    if any(True for _ in made.parameters()):
        raise _unusable_error(argument, path, "it has parameters of its own, which are not trained")
    return made


def _import_object(argument: str, path: str) -> Any:
    """Import `package.module:Name`; modules in the working directory are found, too."""
    module_name, _, name = path.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module_name), name)
    except Exception as error:  # whatever the module's own code raises
        raise _unusable_error(argument, path, f"{type(error).__name__}: {error}") from error
    if not callable(found):
        raise _unusable_error(argument, path, "it is not a class or function")
    return found


def _unusable_error(argument: str, path: str, reason: str) -> InvalidRequest:
    return InvalidRequest("own_module_unusable", f"--{argument} {path} can't be used: {reason}.")
