"""Lightning callback of a training run: checkpoints, validation, graceful stop, and timing.

All state is saved in `on_train_batch_end`, also at the end of an epoch. At that point the state of
Lightning's loops is always the same: one step is complete and the next has not begun. Validation
computes recall@k with the code that `placewise evaluate` uses.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning
import torch

from services.trainer.arguments import TrainingArguments
from services.trainer.checkpointing import (
    SaveCheckpoint,
    TopKCheckpoints,
    restore_rng_state,
    rng_state,
)
from services.trainer.data import Batch, ResumableDataLoader
from services.trainer.model_describer import ModelDescriber
from services.trainer.module import MetricLearningModule
from services.trainer.run_control import Display, StopRequest
from services.trainer.run_folder import EpochRecord, TrainingHistory
from shared.datasets.dataset import EvaluationSet
from shared.evaluation.ranking import Recalls, evaluate_recall

BATCH_PHOTOS = 32

ProgressCallback = Callable[[str, int, int], None]


class Validator:
    """Computes the recalls of a network on evaluation sets.

    Validation photos are resized to `image_size`, test photos to `test_image_size`.
    """

    def __init__(
        self,
        arguments: TrainingArguments,
        device: torch.device,
        on_progress: ProgressCallback,
        stop: StopRequest,
    ) -> None:
        self._arguments = arguments
        self._device = device
        self._on_progress = on_progress
        self._stop = stop

    def measure(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], *, for_tests: bool = False
    ) -> dict[str, Recalls]:
        """Evaluate the network on each set.

        Args:
            model: (B, 3, H, W) float32 -> (B, D); its training mode is restored afterwards.
            sets: the evaluation sets.
            for_tests: use `test_image_size` instead of `image_size`.

        Returns:
            Recalls by set name.

        Raises:
            RunStopped: a stop was requested; also raises what describing and searching raise.
        """
        size = self._test_size() if for_tests else self._arguments.image_size
        describe = ModelDescriber(
            model, self._device, size, batch_photos=1 if size is None else BATCH_PHOTOS
        )
        recalls = {}
        for each in sets:

            def on_progress(what: str, done: int, total: int, name: str = each.name) -> None:
                self._stop.check()
                self._on_progress(f"{name}: {what}", done, total)

            result = evaluate_recall(
                describe, each, faiss_gpu=self._arguments.faiss_gpu, on_progress=on_progress
            )
            recalls[each.name] = result.recalls
        return recalls

    def sanity_check(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], batches: int
    ) -> None:
        """Evaluate the first `batches` of each set (-1: all), to find errors before training."""
        limit = batches * BATCH_PHOTOS if batches >= 0 else None
        truncated = [
            replace(
                each,
                database=each.database[:limit],
                queries=each.queries[:limit],
                positives=tuple(
                    rows if limit is None else rows[rows < limit] for rows in each.positives[:limit]
                ),
            )
            for each in sets
        ]
        if batches:
            self.measure(model, truncated)

    def _test_size(self) -> tuple[int, int] | None:
        size = self._arguments.test_image_size
        if size == "same":
            return self._arguments.image_size
        return None if size == "native" else size


def flatten_recalls(recalls_by_set: dict[str, Recalls]) -> dict[str, float]:
    """Return recalls as metrics `SET/R1`, `SET/R5` ..., from 0 to 1.

    A query without a positive counts as a miss.
    """
    return {
        f"{name}/R{k}": recall
        for name, recalls in recalls_by_set.items()
        for k, recall in recalls.recall_all.items()
    }


MAX_BAD_PHOTO_WARNINGS = 10


class TrainingCallback(lightning.Callback):
    """Saves checkpoints, validates, records the history, and stops the run on request.

    Raises RunStopped from `Trainer.fit` after the state has been saved.
    """

    def __init__(
        self,
        arguments: TrainingArguments,
        folder: Path,
        batches: ResumableDataLoader,
        sets: Sequence[EvaluationSet],
        validator: Validator,
        checkpoints: TopKCheckpoints,
        history: TrainingHistory,
        stop: StopRequest,
        display: Display,
    ) -> None:
        self._arguments = arguments
        self._folder = folder
        self._batches = batches
        self._sets = sets
        self._validator = validator
        self._checkpoints = checkpoints
        self._history = history
        self._stop = stop
        self._display = display
        self._rng_state: dict[str, Any] | None = None
        self._started_at = 0.0
        self._last_saved_step = -1

    def state_dict(self) -> dict[str, Any]:
        return rng_state()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._rng_state = state_dict

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        self._stop.install_handlers()
        if self._rng_state is not None:
            restore_rng_state(self._rng_state)
        self._start_timer()

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
    ) -> None:
        assert isinstance(pl_module, MetricLearningModule)
        self._record_undecodable(batch)
        self._history.images += len(batch.photos)
        epoch = trainer.current_epoch
        max_steps = self._arguments.max_steps
        is_last_step = self._arguments.fast_dev_run or (
            max_steps is not None and trainer.global_step >= max_steps
        )
        self._show_progress(pl_module, epoch, batch_idx + 1)
        if trainer.is_last_batch or is_last_step:
            self._stop_timer()
            self._end_epoch(trainer, pl_module, is_last_step)
            self._start_timer()
        if is_last_step:
            trainer.should_stop = True
        elif self._stop.is_requested:
            self._save_last(trainer)
            self._stop.check()

    def on_exception(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        exception: BaseException,
    ) -> None:
        self._stop_timer()

    def _end_epoch(
        self, trainer: lightning.Trainer, module: MetricLearningModule, is_last_step: bool
    ) -> None:
        if self._arguments.fast_dev_run:
            return
        epoch = trainer.current_epoch
        # Saved before validation, which may take long and may be interrupted.
        self._save_last(trainer)
        if not is_validation_epoch(epoch, self._arguments) and not is_last_step:
            return
        metrics = flatten_recalls(self._validator.measure(module.model, self._sets))
        for logger in trainer.loggers:
            logger.log_metrics({**metrics, "epoch": epoch}, trainer.global_step)
        record_epoch(
            EpochRecord(epoch, trainer.global_step, module.last_loss, metrics),
            self._history,
            self._checkpoints,
            trainer.save_checkpoint,
            self._display,
        )
        self._history.save(self._folder)

    def _save_last(self, trainer: lightning.Trainer) -> None:
        if self._last_saved_step == trainer.global_step:
            return
        self._stop_timer()
        self._history.save(self._folder)
        self._checkpoints.save_last(trainer.save_checkpoint)
        self._last_saved_step = trainer.global_step
        self._start_timer()

    def _record_undecodable(self, batch: Batch) -> None:
        for path, reason in batch.undecodable:
            if path in self._history.bad_photos:
                continue
            self._history.bad_photos[path] = reason
            count = len(self._history.bad_photos)
            if count <= MAX_BAD_PHOTO_WARNINGS:
                self._display.warn(f"Skipped {path}: it cannot be decoded: {reason}")
            elif count == MAX_BAD_PHOTO_WARNINGS + 1:
                self._display.warn("More photos cannot be decoded; metrics.json lists all of them.")

    def _show_progress(self, module: MetricLearningModule, epoch: int, done: int) -> None:
        accuracy = "" if module.last_accuracy is None else f"  b_acc {module.last_accuracy:.2f}"
        self._display.progress(
            f"epoch {epoch + 1}/{self._arguments.max_epochs}",
            done,
            len(self._batches),
            f"loss {module.last_loss:.4f}{accuracy}",
        )

    def _start_timer(self) -> None:
        self._started_at = time.perf_counter()
        self._batches.seconds_waited = 0.0

    def _stop_timer(self) -> None:
        if self._started_at:
            self._history.seconds += time.perf_counter() - self._started_at
            self._history.seconds_waited += self._batches.seconds_waited
        self._started_at = 0.0


def is_validation_epoch(epoch: int, arguments: TrainingArguments) -> bool:
    """Return whether validation follows this epoch: every n epochs, and after the last one."""
    epochs_done = epoch + 1
    return (
        epochs_done % arguments.check_val_every_n_epoch == 0 or epochs_done >= arguments.max_epochs
    )


def record_epoch(
    epoch: EpochRecord,
    history: TrainingHistory,
    checkpoints: TopKCheckpoints,
    save: SaveCheckpoint,
    display: Display,
) -> None:
    """Record an epoch's metrics: in the history, on the display, and among the best checkpoints."""
    history.epochs.append(epoch)
    is_best = checkpoints.save_if_best(save, epoch.figures, epoch.number, epoch.step)
    history.best = list(checkpoints.best)
    headline = "  ".join(
        f"{name} {value:.1%}" for name, value in epoch.figures.items() if _is_headline_metric(name)
    )
    suffix = " (checkpoint saved)" if is_best else ""
    display.info(f"epoch {epoch.number + 1}: loss {epoch.loss:.4f}  {headline}{suffix}")


def _is_headline_metric(name: str) -> bool:
    return name.endswith(("/R1", "/R5"))
