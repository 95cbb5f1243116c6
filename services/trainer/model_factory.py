"""Creates the network of a run: pretrained weights, those of a checkpoint, or random weights."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from services.trainer.arguments import TrainingArguments
from services.trainer.run_control import Display
from shared.descriptors.vpr_models.checkpoint import is_checkpoint, load_checkpoint
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.errors import Conflict


def build_model_config(arguments: TrainingArguments) -> VprModelConfig:
    """Build the model configuration from the arguments; raises what `VprModelConfig.parse` does."""
    return VprModelConfig.parse(
        {name: getattr(arguments, name) for name in VprModelConfig.model_fields}
        | {"image_size": arguments.evaluation_size}
    )


def make_model(arguments: TrainingArguments, display: Display, *, resuming: bool) -> VprModel:
    """Create the network with pretrained weights, those of a checkpoint, or random weights.

    Random weights depend on the global seed. With `resuming`, the weights are loaded later, from
    the run's checkpoint.

    Raises:
        Conflict: `run_differs`, if the checkpoint's network differs from the arguments'. Also
            raises what `build_vpr_model` and `load_checkpoint` raise.
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
    return build_vpr_model(config, weights=arguments.weights)


def _initial_checkpoint(arguments: TrainingArguments) -> Path | None:
    """Return `model_path`, or `weights` if they are those of a complete network."""
    if arguments.model_path is not None:
        return arguments.model_path
    weights = arguments.weights if arguments.pretrained else None
    return weights if weights is not None and is_checkpoint(weights) else None


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
