"""Own backbones, aggregators, losses and miners, named `package.module:Name` in the arguments.

Importing them executes code, so only the arguments of a run do that, never a checkpoint: a
checkpoint of such a network is loaded while its names are registered, and is an error elsewhere.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import nn

from services.trainer.arguments import TrainingArguments
from shared.descriptors.vpr_models.aggregators import AGGREGATORS
from shared.descriptors.vpr_models.aggregators.base import Aggregator
from shared.descriptors.vpr_models.backbones import register_backbone
from shared.descriptors.vpr_models.config import is_own_module
from shared.errors import InvalidRequest


def register_own_modules(arguments: TrainingArguments) -> None:
    """Import the backbone and the aggregator that the arguments name by module path.

    Raises:
        InvalidRequest: `own_module_unfit`, if one cannot be imported or is not what it should be.
    """
    if is_own_module(arguments.backbone_arch):
        build: Callable[[bool], nn.Module] = _import_object(
            "backbone_arch", arguments.backbone_arch
        )
        register_backbone(arguments.backbone_arch, build)
    if is_own_module(arguments.agg_arch):
        aggregator = _import_object("agg_arch", arguments.agg_arch)
        if not (isinstance(aggregator, type) and issubclass(aggregator, Aggregator)):
            raise _unfit_error(
                "agg_arch",
                arguments.agg_arch,
                "it is not a subclass of Aggregator "
                "(shared.descriptors.vpr_models.aggregators.base)",
            )
        AGGREGATORS[arguments.agg_arch] = aggregator


def make_own_module(argument: str, path: str) -> nn.Module:
    """Create a loss or miner of the user by calling what `path` names, without arguments.

    Raises:
        InvalidRequest: `own_module_unfit`; also for a module with parameters, because the optimizer
            trains those of the network only.
    """
    try:
        made = _import_object(argument, path)()
    except TypeError as error:
        raise _unfit_error(argument, path, str(error)) from error
    if not isinstance(made, nn.Module):
        raise _unfit_error(argument, path, "it does not make a torch.nn.Module")
    if any(True for _ in made.parameters()):
        raise _unfit_error(argument, path, "it has parameters of its own, which are not trained")
    return made


def _import_object(argument: str, path: str) -> Any:
    """Import `package.module:Name`; modules in the working directory are found, too.

    Raises:
        InvalidRequest: `own_module_unfit`.
    """
    module_name, _, name = path.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module_name), name)
    except Exception as error:  # whatever the module's own code raises
        raise _unfit_error(argument, path, f"{type(error).__name__}: {error}") from error
    if not callable(found):
        raise _unfit_error(argument, path, "it is not a class or function")
    return found


def _unfit_error(argument: str, path: str, reason: str) -> InvalidRequest:
    return InvalidRequest("own_module_unfit", f"--{argument} {path} can't be used: {reason}.")
