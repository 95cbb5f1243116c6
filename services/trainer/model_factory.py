"""Creates the network of a run: pretrained weights, those of a checkpoint, or random weights."""

from __future__ import annotations

from services.trainer.arguments import TrainingArguments
from services.trainer.run_control import Display
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.errors import Conflict


def build_model_config(arguments: TrainingArguments) -> VprModelConfig:
    """Build the model configuration from the arguments; raises what `VprModelConfig.parse` does."""
    return VprModelConfig.parse(
        {name: getattr(arguments, name) for name in VprModelConfig.model_fields}
    )


def make_model(arguments: TrainingArguments, display: Display, *, resuming: bool) -> VprModel:
    """Create the network with pretrained weights, those of `model_path`, or random weights.

    Args:
        arguments: the run's arguments; random weights depend on the global seed.
        display: receives a warning if frozen layers have random weights.
        resuming: the weights are loaded later, from the run's checkpoint.

    Raises:
        Conflict: `run_differs`, if the checkpoint's network differs from the arguments'. Also
            raises what `build_vpr_model` and `load_checkpoint` raise.
    """
    config = build_model_config(arguments)
    has_checkpoint = resuming or arguments.model_path is not None
    if has_checkpoint:
        model = build_vpr_model(config.model_copy(update={"pretrained": False}))
        model.config = model.config.model_copy(update={"pretrained": config.pretrained})
    else:
        model = build_vpr_model(config, weights=arguments.weights)
    if arguments.model_path is not None and not resuming:
        initial = load_checkpoint(arguments.model_path).model
        if initial.config.model_dump(exclude=_TRAINING_ONLY_FIELDS) != model.config.model_dump(
            exclude=_TRAINING_ONLY_FIELDS
        ):
            raise Conflict(
                "run_differs",
                f"The network of --model_path {arguments.model_path} differs from the one that the "
                f"arguments describe: {initial.config.model_dump_json()}",
            )
        model.load_state_dict(initial.state_dict())
    if not config.pretrained and not has_checkpoint and config.layers_to_freeze >= 0:
        display.warn(
            f"--layers_to_freeze {config.layers_to_freeze} freezes layers whose weights are random "
            "(--pretrained False): they never learn. Use --layers_to_freeze -1 to train them."
        )
    return model


_TRAINING_ONLY_FIELDS = {"pretrained", "layers_to_freeze"}
