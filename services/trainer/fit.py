"""Lightning's part of a run: its trainer, as quiet and as repeatable as a run wants it."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.loggers import Logger

from services.trainer.arguments import TrainingArguments
from services.trainer.batches import ResumableDataLoader
from services.trainer.device import Device
from services.trainer.learner import MetricLearningModule
from services.trainer.watch import TrainingCallback


def fit(
    module: MetricLearningModule,
    batches: ResumableDataLoader,
    callback: TrainingCallback,
    arguments: TrainingArguments,
    device: Device,
    folder: Path,
    loggers: Sequence[Logger],
    resume_from: Path | None,
) -> None:
    """Learn until the arguments' end, from the beginning or from a checkpoint with the full state.

    Validation and checkpoints are the watch's, not Lightning's. Raises RunStopped and what steps
    raise.
    """
    # Its tips and its advice on numbers of workers are not what a run's user asked for.
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"lightning\.")
        trainer = lightning.Trainer(
            accelerator=device.accelerator,
            devices=device.devices,
            precision=_precision(device),
            max_epochs=arguments.max_epochs,
            log_every_n_steps=arguments.log_every_n_steps,
            logger=list(loggers) or False,
            callbacks=[callback],
            default_root_dir=folder,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
        )
        module.train()
        trainer.fit(
            module,
            batches,
            ckpt_path=resume_from,
            weights_only=True if resume_from is not None else None,
        )


def _precision(device: Device) -> Any:
    return device.precision
