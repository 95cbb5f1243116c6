"""Resolves a run's arguments against the machine and the data before the first step.

Checks the accelerator, the device index, the precision and the loggers' packages before any data is
read; creates the loggers and the checkpoint settings.
"""

from __future__ import annotations

import csv
import importlib.util
import shutil
from pathlib import Path
from typing import Any

import torch
from lightning.fabric import Fabric
from lightning.pytorch.loggers import (
    CSVLogger,
    Logger,
    MLFlowLogger,
    TensorBoardLogger,
    WandbLogger,
)

from lab.datasets.dataset import TrainingSet
from lab.evaluation.exact_knn import has_faiss_gpu
from lab.training.arguments import TrainingArguments, no_gpu_error, to_plain_dict
from lab.training.checkpointing import CheckpointNameTemplate, TopKCheckpoints
from lab.training.data import EvaluationSets
from lab.training.run_control import Display
from lab.training.run_folder import CHECKPOINTS_FOLDER, VALIDATION_KS
from shared.errors import InvalidRequest, Misconfigured

PRECISION_ALIASES = {
    **dict.fromkeys(("32", "32-true"), "32-true"),
    **dict.fromkeys(("16", "16-mixed"), "16-mixed"),
    **dict.fromkeys(("bf16", "bf16-mixed"), "bf16-mixed"),
}


def make_fabric(arguments: TrainingArguments) -> Fabric:
    """Create the Fabric of a run: one device and a precision.

    Raises Misconfigured (`no_gpu`), InvalidRequest (`several_devices`, `unknown_precision`,
    `needs_gpu`).
    """
    accelerator = _resolve_accelerator(arguments.accelerator)
    index = _device_index(arguments.devices)
    precision: Any = PRECISION_ALIASES.get(str(arguments.precision))
    if precision is None:
        raise InvalidRequest(
            "unknown_precision",
            f"--precision {arguments.precision} is unknown; known: {', '.join(PRECISION_ALIASES)}.",
        )
    if accelerator != "gpu":
        if precision == "16-mixed":
            raise InvalidRequest(
                "needs_gpu", "--precision 16-mixed needs a CUDA GPU; bf16-mixed and 32 do not."
            )
        return Fabric(accelerator=accelerator, devices=1, precision=precision)
    if index >= torch.cuda.device_count():
        raise Misconfigured(
            "no_gpu",
            f"--devices [{index}] does not exist: this machine has {torch.cuda.device_count()} "
            "GPUs, numbered from 0.",
        )
    return Fabric(accelerator="gpu", devices=[index], precision=precision)


def _resolve_accelerator(requested: str) -> str:
    if requested == "auto":
        if torch.cuda.is_available():
            return "gpu"
        return "mps" if torch.backends.mps.is_available() else "cpu"
    if requested in ("gpu", "cuda"):
        if not torch.cuda.is_available():
            raise no_gpu_error("PyTorch finds no CUDA GPU")
        return "gpu"
    if requested == "mps" and not torch.backends.mps.is_available():
        raise Misconfigured("no_gpu", "PyTorch finds no MPS device. Use --accelerator cpu.")
    return requested


def _device_index(devices: int | str | tuple[int, ...]) -> int:
    if devices in (1, "1", "auto"):
        return 0
    if isinstance(devices, tuple) and len(devices) == 1 and devices[0] >= 0:
        return devices[0]
    raise InvalidRequest(
        "several_devices",
        f"--devices {devices}: a run uses a single device. Give 1, or the device's index as [0]. "
        "To use several GPUs, start several runs, each with its own index.",
    )


def make_loggers(
    names: tuple[str, ...], folder: Path, arguments: dict[str, Any], completed_steps: int = 0
) -> list[Logger]:
    """Create Lightning loggers by name; that of a resumed run continues its CSV file.

    Only `wandb` needs an account, and it can run offline (`WANDB_MODE=offline`). `completed_steps`
    are those of the checkpoint that the run resumes; later rows are dropped.
    """
    loggers: list[Logger] = []
    for name in names:
        if name == "csv":
            loggers.append(_continue_csv(folder, completed_steps))
        elif name == "tensorboard":
            loggers.append(TensorBoardLogger(folder, name="", version="tensorboard"))
        elif name == "wandb":
            loggers.append(WandbLogger(name=folder.name, save_dir=folder, project="placewise"))
        else:
            loggers.append(MLFlowLogger(run_name=folder.name, save_dir=str(folder / "mlflow")))
    for logger in loggers:
        logger.log_hyperparams(arguments)
    return loggers


def _continue_csv(folder: Path, completed_steps: int) -> CSVLogger:
    """Create a CSV logger that begins with the rows that earlier parts of the run have logged."""
    file = folder / "csv" / "version_0" / "metrics.csv"
    rows: list[dict[str, Any]] = []
    if file.is_file():
        with file.open(newline="") as opened:
            rows = list(csv.DictReader(opened))
        shutil.rmtree(file.parent)  # the logger would warn and delete it
    logger = CSVLogger(folder, name="csv", version=0)
    for row in rows:
        if int(row["step"]) <= completed_steps:
            logged = {name: value for name, value in row.items() if value != ""}
            logger.log_metrics(logged, int(row["step"]))
    logger.save()
    return logger


def check_loggers(names: tuple[str, ...]) -> None:
    """Check that the loggers' packages are installed.

    Raises Misconfigured: `logger_missing`.
    """
    for name in names:
        if name != "csv" and importlib.util.find_spec(name) is None:
            raise Misconfigured(
                "logger_missing",
                f"--logger {name} requires the package {name}. Install it, or choose other "
                "loggers (csv, tensorboard, none).",
            )


Json = dict[str, Any]


def check_environment(arguments: TrainingArguments, display: Display) -> Fabric:
    """Check device and loggers, and return the Fabric; warn if faiss can't use the GPU.

    Raises what `make_fabric` and `check_loggers` raise.
    """
    fabric = make_fabric(arguments)
    check_loggers(arguments.logger)
    if arguments.faiss_gpu and not has_faiss_gpu():
        display.warn(
            "Evaluations search on the CPU, with the same results: faiss can't use a GPU here "
            "(--faiss_gpu False omits this warning)."
        )
    return fabric


def list_changed_meanings(arguments: TrainingArguments) -> list[str]:
    """Return a line for each argument whose value had another effect in the GSV-Cities code.

    With `compatible`, they have that effect: one line says what that is.
    """
    if arguments.compatible:
        effect = (
            f"--compatible: --optimizer {arguments.optimizer} --layers_to_freeze "
            f"{arguments.layers_to_freeze} --test_image_size {arguments.test_image_size}; "
            "milestones within the warm-up have no effect."
        )
        return [effect]
    notes = []
    if arguments.optimizer == "adam" and arguments.weight_decay > 0:
        notes.append(
            "--optimizer adam is Adam. The GSV-Cities script ran AdamW by this name: for the same "
            "training use --optimizer adamw or --compatible."
        )
    if arguments.experiment_phase != "train" and arguments.test_image_size == "same":
        height, width = arguments.evaluation_size
        notes.append(
            f"Test photos are resized to {height} x {width} pixels. The GSV-Cities script tested "
            "them at their own size: for the same figures use --test_image_size native or "
            "--compatible."
        )
    if arguments.layers_to_freeze >= 0 and arguments.experiment_phase != "test":
        notes.append(
            f"--layers_to_freeze {arguments.layers_to_freeze} freezes layers. The GSV-Cities "
            "script froze none: for the same training use --layers_to_freeze -1 or --compatible."
        )
    return notes


def resolve_arguments(
    arguments: TrainingArguments, places: TrainingSet, sets: EvaluationSets
) -> TrainingArguments:
    """Fill in the arguments that depend on the data: sets, cities, absolute paths, monitor.

    Raises InvalidRequest: `bad_argument`, if places may have fewer than `img_per_place` photos.
    """
    if arguments.img_per_place > arguments.min_img_per_place:
        raise InvalidRequest(
            "bad_argument",
            f"--img_per_place {arguments.img_per_place} exceeds --min_img_per_place "
            f"{arguments.min_img_per_place}: places without enough photos would be sampled.",
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
    """Create the checkpoint settings of a run.

    Raises InvalidRequest: `unknown_metric`, `bad_argument`.
    """
    metrics = [f"{each.name}/R{k}" for each in sets.validation for k in VALIDATION_KS]
    if not metrics:
        display.warn("There is no validation set: only last.ckpt is saved.")
    elif arguments.monitor not in metrics:
        raise InvalidRequest(
            "unknown_metric",
            f"--monitor {arguments.monitor} is not a metric of this run; known: "
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
        display.warn(f"--filename: {dropped} is not a metric of this run; it is removed.")
    return TopKCheckpoints(
        folder / CHECKPOINTS_FOLDER,
        name,
        arguments.monitor,
        arguments.mode,
        arguments.save_top_k,
        arguments.save_weights_only,
    )


LOCAL_PATHS = {"data_root", "eval_roots", "weights", "model_path", "default_root_dir"}


def portable_arguments(arguments: TrainingArguments) -> Json:
    """Return the arguments that a checkpoint stores: all except local paths."""
    return arguments.model_dump(mode="json", exclude=LOCAL_PATHS)
