"""What happens around a run's steps: keeping, measuring, stopping, counting.

Everything is kept in `on_train_batch_end`, also at an epoch's end. There the state of Lightning's
loops is always the same: one step is done and the next one has not begun.

The evaluation sets of a run, measured as `placewise evaluate` measures them.
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
    """Measures a network on sets, one after the other.

    Validation photos have the size that the training's have; `for_tests` uses `test_image_size`.
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
        self._told = on_progress
        self._stop = stop

    def measure(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], *, for_tests: bool = False
    ) -> dict[str, Recalls]:
        """By the sets' names. Raises RunStopped, and what describing and searching raise."""
        size = self._test_size() if for_tests else self._arguments.image_size
        describe = ModelDescriber(
            model, self._device, size, batch_photos=1 if size is None else BATCH_PHOTOS
        )
        found = {}
        for each in sets:

            def told(what: str, done: int, most: int, name: str = each.name) -> None:
                self._stop.check()
                self._told(f"{name}: {what}", done, most)

            asked = evaluate_recall(
                describe, each, faiss_gpu=self._arguments.faiss_gpu, on_progress=told
            )
            found[each.name] = asked.recalls
        return found

    def sanity_check(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], batches: int
    ) -> None:
        """Measure the first batches of each set, -1: all, so that a fault in them shows early."""
        most = batches * BATCH_PHOTOS if batches >= 0 else None
        begun = [
            replace(
                each,
                database=each.database[:most],
                queries=each.queries[:most],
                positives=tuple(
                    found if most is None else found[found < most]
                    for found in each.positives[:most]
                ),
            )
            for each in sets
        ]
        if batches:
            self.measure(model, begun)

    def _test_size(self) -> tuple[int, int] | None:
        size = self._arguments.test_image_size
        if size == "same":
            return self._arguments.image_size
        return None if size == "native" else size


def flatten_recalls(recalls_by_set: dict[str, Recalls]) -> dict[str, float]:
    """`SET/R1`, `SET/R5` ... -> shares from 0 to 1; a query without a positive counts as missed."""
    return {
        f"{name}/R{k}": share
        for name, one in recalls_by_set.items()
        for k, share in one.recall_all.items()
    }


MAX_BAD_PHOTO_WARNINGS = 10


class TrainingCallback(lightning.Callback):
    """Drives `kept`, `validation` and `history` of one run. Raises RunStopped out of `fit`."""

    def __init__(
        self,
        arguments: TrainingArguments,
        folder: Path,
        batches: ResumableDataLoader,
        sets: Sequence[EvaluationSet],
        validation: Validator,
        kept: TopKCheckpoints,
        history: TrainingHistory,
        stop: StopRequest,
        display: Display,
    ) -> None:
        self._arguments = arguments
        self._folder = folder
        self._batches = batches
        self._sets = sets
        self._validation = validation
        self._kept = kept
        self._history = history
        self._stop = stop
        self._display = display
        self._random_state: dict[str, Any] | None = None
        self._began = 0.0
        self._last_saved_step = -1

    def state_dict(self) -> dict[str, Any]:
        return rng_state()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._random_state = state_dict

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        self._stop.install_handlers()
        if self._random_state is not None:
            restore_rng_state(self._random_state)
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
        most = self._arguments.max_steps
        ends = self._arguments.fast_dev_run or (most is not None and trainer.global_step >= most)
        self._show(pl_module, epoch, batch_idx + 1)
        if trainer.is_last_batch or ends:
            self._stop_timer()
            self._end_epoch(trainer, pl_module, ends)
            self._start_timer()
        if ends:
            trainer.should_stop = True
        elif self._stop.asked:
            self._keep(trainer)
            self._stop.check()

    def on_exception(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        exception: BaseException,
    ) -> None:
        self._stop_timer()

    def _end_epoch(
        self, trainer: lightning.Trainer, learner: MetricLearningModule, ends: bool
    ) -> None:
        if self._arguments.fast_dev_run:
            return
        epoch = trainer.current_epoch
        # Before the sets are measured, which may take long and be interrupted.
        self._keep(trainer)
        if not is_validation_epoch(epoch, self._arguments) and not ends:
            return
        found = flatten_recalls(self._validation.measure(learner.model, self._sets))
        for logger in trainer.loggers:
            logger.log_metrics({**found, "epoch": epoch}, trainer.global_step)
        record_epoch(
            EpochRecord(epoch, trainer.global_step, learner.last_loss, found),
            self._history,
            self._kept,
            trainer.save_checkpoint,
            self._display,
        )
        self._history.save(self._folder)

    def _keep(self, trainer: lightning.Trainer) -> None:
        if self._last_saved_step == trainer.global_step:
            return
        self._stop_timer()
        self._history.save(self._folder)
        self._kept.save_last(trainer.save_checkpoint)
        self._last_saved_step = trainer.global_step
        self._start_timer()

    def _record_undecodable(self, batch: Batch) -> None:
        for path, reason in batch.undecodable:
            if path in self._history.bad_photos:
                continue
            self._history.bad_photos[path] = reason
            count = len(self._history.bad_photos)
            if count <= MAX_BAD_PHOTO_WARNINGS:
                self._display.warn(f"{path} is left out, it does not decode: {reason}")
            elif count == MAX_BAD_PHOTO_WARNINGS + 1:
                self._display.warn("More photos do not decode; metrics.json names them all.")

    def _show(self, learner: MetricLearningModule, epoch: int, done: int) -> None:
        accuracy = "" if learner.last_accuracy is None else f"  b_acc {learner.last_accuracy:.2f}"
        self._display.progress(
            f"epoch {epoch + 1}/{self._arguments.max_epochs}",
            done,
            len(self._batches),
            f"loss {learner.last_loss:.4f}{accuracy}",
        )

    def _start_timer(self) -> None:
        self._began = time.perf_counter()
        self._batches.seconds_waited = 0.0

    def _stop_timer(self) -> None:
        if self._began:
            self._history.seconds += time.perf_counter() - self._began
            self._history.seconds_waited += self._batches.seconds_waited
        self._began = 0.0


def is_validation_epoch(epoch: int, arguments: TrainingArguments) -> bool:
    """Every so many epochs, and after the last."""
    done = epoch + 1
    return done % arguments.check_val_every_n_epoch == 0 or done >= arguments.max_epochs


def record_epoch(
    epoch: EpochRecord,
    history: TrainingHistory,
    kept: TopKCheckpoints,
    save: SaveCheckpoint,
    display: Display,
) -> None:
    """An epoch's figures: into the history, on the display, and its checkpoint among the best."""
    history.epochs.append(epoch)
    is_best = kept.save_if_best(save, epoch.figures, epoch.number, epoch.step)
    history.best = list(kept.best)
    figures = "  ".join(
        f"{name} {share:.1%}" for name, share in epoch.figures.items() if _is_headline_metric(name)
    )
    place = " (kept)" if is_best else ""
    display.info(f"epoch {epoch.number + 1}: loss {epoch.loss:.4f}  {figures}{place}")


def _is_headline_metric(name: str) -> bool:
    return name.endswith(("/R1", "/R5"))
