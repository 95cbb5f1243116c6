"""The network that a run begins with."""

from __future__ import annotations

from services.trainer.arguments import TrainingArguments
from services.trainer.display import Display
from shared.errors import Conflict
from shared.vision.place_models.checkpoint import load_checkpoint
from shared.vision.place_models.config import VprModelConfig
from shared.vision.place_models.model import VprModel, build_vpr_model


def build_model_config(arguments: TrainingArguments) -> VprModelConfig:
    """The model that the arguments describe; raises what `ModelConfig.read` does."""
    return VprModelConfig.parse(
        {name: getattr(arguments, name) for name in VprModelConfig.model_fields}
    )


def make_model(arguments: TrainingArguments, display: Display, *, resuming: bool) -> VprModel:
    """With pretrained weights, with those of `model_path`, or random by the seed.

    One that resumes gets its weights later. Raises what `build_vpr_model` and `load_checkpoint` do, and
    Conflict (`run_differs`) for a checkpoint of another network.
    """
    config = build_model_config(arguments)
    elsewhere = resuming or arguments.model_path is not None
    if elsewhere:
        model = build_vpr_model(config.model_copy(update={"pretrained": False}))
        model.config = model.config.model_copy(update={"pretrained": config.pretrained})
    else:
        model = build_vpr_model(config, weights=arguments.weights)
    if arguments.model_path is not None and not resuming:
        begun = load_checkpoint(arguments.model_path).model
        if begun.config.model_dump(exclude=_TRAINING_ONLY_FIELDS) != model.config.model_dump(
            exclude=_TRAINING_ONLY_FIELDS
        ):
            raise Conflict(
                "run_differs",
                f"--model_path {arguments.model_path} is another network than the arguments "
                f"describe: {begun.config.model_dump_json()}",
            )
        model.load_state_dict(begun.state_dict())
    if not config.pretrained and not elsewhere and config.layers_to_freeze >= 0:
        display.warn(
            f"--layers_to_freeze {config.layers_to_freeze} freezes layers whose weights are random "
            "(--pretrained False): they never learn. Say --layers_to_freeze -1 to train them."
        )
    return model


_TRAINING_ONLY_FIELDS = {"pretrained", "layers_to_freeze"}
