"""Where a run's figures go while it learns."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import (
    CSVLogger,
    Logger,
    MLFlowLogger,
    TensorBoardLogger,
    WandbLogger,
)

from shared.errors import Misconfigured

LOGGER_PACKAGES = {"tensorboard": ("tensorboard",), "wandb": ("wandb",), "mlflow": ("mlflow",)}


def make_loggers(names: tuple[str, ...], folder: Path, arguments: dict[str, Any]) -> list[Logger]:
    """One logger for each name. None needs an account but `wandb`, which can be offline
    (`WANDB_MODE=offline`).

    Raises Misconfigured (`logger_missing`) for one whose package is not installed.
    """
    check_loggers(names)
    made: list[Logger] = []
    for name in names:
        if name == "csv":
            made.append(CSVLogger(folder, name="csv"))
        elif name == "tensorboard":
            made.append(TensorBoardLogger(folder, name="", version="tensorboard"))
        elif name == "wandb":
            made.append(WandbLogger(name=folder.name, save_dir=folder, project="placewise"))
        else:
            made.append(MLFlowLogger(run_name=folder.name, save_dir=str(folder / "mlflow")))
    for logger in made:
        logger.log_hyperparams(arguments)
    return made


def check_loggers(names: tuple[str, ...]) -> None:
    """As `make_loggers` raises, before anything else is done."""
    for name in names:
        for package in LOGGER_PACKAGES.get(name, ()):
            if importlib.util.find_spec(package) is None:
                raise Misconfigured(
                    "logger_missing",
                    f"--logger {name} needs the package {package}: install it, or name others "
                    "(csv, tensorboard, none).",
                )
