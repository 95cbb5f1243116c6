"""What a run's arguments mean on this machine and with this data, before its first step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from services.trainer.arguments import TrainingArguments
from services.trainer.checkpoint_names import CheckpointNameTemplate
from services.trainer.configuration import to_plain_dict
from services.trainer.device import Device, resolve_device
from services.trainer.display import Display
from services.trainer.evaluation.nearest import exact_knn
from services.trainer.evaluation.recalls import DEFAULT_KS
from services.trainer.keep import TopKCheckpoints
from services.trainer.loggers import check_loggers
from services.trainer.open_data import EvaluationSets
from services.trainer.run_folder import CHECKPOINTS_FOLDER
from shared.datasets.shots import TrainingSet
from shared.errors import InvalidRequest

Json = dict[str, Any]


def check_environment(arguments: TrainingArguments) -> Device:
    """The device, when all that the arguments need of this machine is there.

    Raises Misconfigured (`no_gpu`, `faiss_gpu_missing`, `logger_missing`), InvalidRequest.
    """
    device = resolve_device(arguments)
    check_loggers(arguments.logger)
    if arguments.faiss_gpu:
        one = np.ones((1, 1), np.float32)
        exact_knn(one, one, 1, faiss_gpu=True)
    return device


def resolve_arguments(
    arguments: TrainingArguments, places: TrainingSet, sets: EvaluationSets
) -> TrainingArguments:
    """The arguments with what was left to the data set filled in."""
    if arguments.img_per_place > arguments.min_img_per_place:
        raise InvalidRequest(
            "bad_argument",
            f"--img_per_place {arguments.img_per_place} is more than --min_img_per_place "
            f"{arguments.min_img_per_place}: places without enough photos would be in the set.",
        )
    assert arguments.data_root is not None
    changes: Json = {
        **sets.names,
        "cities": places.cities,
        "data_root": arguments.data_root.resolve(),
        "eval_roots": tuple(root.resolve() for root in arguments.eval_roots),
    }
    if "monitor" not in arguments.model_fields_set and sets.validation:
        changes["monitor"] = f"{sets.validation[0].name}/R1"
    return TrainingArguments(**{**arguments.model_dump(), **changes})


def make_checkpoints(
    arguments: TrainingArguments, folder: Path, sets: EvaluationSets, display: Display
) -> TopKCheckpoints:
    """The run's checkpoints, none kept yet; InvalidRequest (`unknown_metric`, `bad_argument`)."""
    metrics = [f"{each.name}/R{k}" for each in sets.validation for k in DEFAULT_KS]
    if not metrics:
        display.warn("There is no set to validate on: only last.ckpt is kept.")
    elif arguments.monitor not in metrics:
        raise InvalidRequest(
            "unknown_metric",
            f"--monitor {arguments.monitor} is not measured in this run; known: "
            f"{', '.join(metrics)}.",
        )
    name = CheckpointNameTemplate(
        arguments.filename,
        to_plain_dict(arguments),
        metrics,
        monitored_set=arguments.monitor.rpartition("/")[0],
        insert_names=arguments.auto_insert_metric_name,
    )
    for dropped in name.dropped_fields if metrics else ():
        display.warn(f"--filename: no run on these sets logs {dropped}; it drops out of the names.")
    return TopKCheckpoints(
        folder / CHECKPOINTS_FOLDER,
        name,
        arguments.monitor,
        arguments.mode,
        arguments.save_top_k,
        arguments.save_weights_only,
    )


def portable_arguments(arguments: TrainingArguments) -> Json:
    """What a checkpoint says of its training; no paths of this machine."""
    plain = to_plain_dict(arguments)
    for name in ("data_root", "eval_roots", "weights", "model_path", "default_root_dir"):
        plain.pop(name)
    return plain
