"""The training loop: steps, validation, checkpoints, graceful stop, and exact resume.

It is a plain loop on Lightning Fabric, which places the network on the device and applies the
precision. Lightning's `Trainer` is not used: a run must save its state after a step, before the
validation that follows it, and continue from there with equal bits. The position in the data is the
number of completed steps, so that the state is the model, the optimizer, the gradient scaler, and
the random number generators.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.fabric import Fabric
from lightning.pytorch.loggers import Logger

from lab.datasets.dataset import EvaluationSet, TrainingSet
from lab.training.arguments import TrainingArguments
from lab.training.checkpointing import (
    TopKCheckpoints,
    load_training_state,
    restore_rng_state,
    rng_state,
)
from lab.training.data import Batch, PhotoTransform, PlaceBatchSampler, PlaceDataset, load_batches
from lab.training.losses import batch_accuracy, make_loss, make_miner
from lab.training.resolve import portable_arguments
from lab.training.run_control import Display, StopRequest
from lab.training.run_folder import (
    PREDICTIONS_FOLDER,
    EpochRecord,
    TrainingHistory,
    check_trained_arguments,
)
from lab.training.validation import Validator, flatten_recalls, write_predictions
from shared.descriptors.backbones import normalise_pixels
from shared.descriptors.vpr_models.checkpoint import STATE_DICT_PREFIX, checkpoint_state
from shared.descriptors.vpr_models.model import VprModel
from shared.errors import Conflict, Unprocessable
from shared.extractor_config.names import IMAGENET_MEAN, IMAGENET_STD

MAX_BAD_PHOTO_WARNINGS = 10


def make_optimizer(
    parameters: Iterable[torch.nn.Parameter], arguments: TrainingArguments
) -> torch.optim.Optimizer:
    """Create Adam, AdamW or SGD over the trainable parameters."""
    trainable = [parameter for parameter in parameters if parameter.requires_grad]
    lr, decay = arguments.lr, arguments.weight_decay
    if arguments.optimizer == "sgd":
        return torch.optim.SGD(trainable, lr, arguments.momentum, weight_decay=decay)
    if arguments.optimizer == "adamw":
        return torch.optim.AdamW(trainable, lr, weight_decay=decay)
    return torch.optim.Adam(trainable, lr, weight_decay=decay)


def learning_rate(step: int, steps_per_epoch: int, arguments: TrainingArguments) -> float:
    """Return the learning rate of a step, from 0: linear warm-up times step decay.

    It depends on the step alone, so that a resumed run needs no scheduler state. With `compatible`,
    a milestone within the warm-up has no effect, because the GSV-Cities code overwrote it.
    """
    warmup = min(1.0, (step + 1) / max(1, arguments.warmpup_steps))
    first = arguments.warmpup_steps if arguments.compatible else 0
    passed = sum(
        step // steps_per_epoch >= milestone and milestone * steps_per_epoch >= first
        for milestone in arguments.milestones
    )
    return arguments.lr * warmup * float(arguments.lr_mult**passed)


@dataclass
class TrainingRun:
    """Inputs of a training run; a resumed one continues the history and the checkpoints."""

    arguments: TrainingArguments
    fabric: Fabric
    training_set: TrainingSet
    validation_sets: Sequence[EvaluationSet]
    model: VprModel
    folder: Path
    history: TrainingHistory
    checkpoints: TopKCheckpoints


class TrainingLoop:
    """Trains a network: photos -> descriptors -> mined pairs or triplets -> loss.

    The history and the checkpoints of the run are updated.
    """

    def __init__(
        self, run: TrainingRun, validator: Validator, display: Display, stop: StopRequest
    ) -> None:
        arguments = run.arguments
        self._run = run
        self._arguments = arguments
        self._validator = validator
        self._display = display
        self._stop = stop
        self._sampler = PlaceBatchSampler(
            run.training_set.places,
            arguments.batch_size,
            arguments.img_per_place,
            arguments.shuffle_all,
            arguments.random_sample_from_each_place,
            arguments.reload_dataloaders_every_n_epochs,
            arguments.seed,
        )
        self._dataset = PlaceDataset(
            self._sampler,
            PhotoTransform(
                arguments.image_size,
                arguments.interpolation,
                arguments.randaugment_magnitude
                if arguments.augmentation == "randaugment"
                else None,
            ),
            fail_on_undecodable=arguments.on_bad_image == "error",
        )
        self._loss = make_loss(arguments.loss_name)
        self._miner = make_miner(arguments.miner_name, arguments.miner_margin)
        self._fabric = run.fabric
        self._precision = self._fabric.strategy.precision
        # Channels last and TF32 make convolutions faster on a GPU only.
        on_gpu = self._fabric.device.type == "cuda"
        self._memory_format = torch.channels_last if on_gpu else torch.contiguous_format
        run.model.to(memory_format=self._memory_format)
        network: Any = torch.compile(run.model) if arguments.compile else run.model
        optimizer = make_optimizer(run.model.parameters(), arguments)
        self._network, self._optimizer = self._fabric.setup(network, optimizer)
        last_step = arguments.max_epochs * len(self._sampler)
        self._last_step = min(last_step, arguments.max_steps or last_step)
        self.completed_steps = 0
        self._last_loss = float("nan")
        self._last_saved_step = -1

    def restore(self, checkpoint: Path) -> None:
        """Restore the full training state.

        Raises Conflict (`run_differs`) if the checkpoint belongs to a run with other arguments, or
        the run ends before it, and what `load_training_state` raises.
        """
        stored = load_training_state(checkpoint)
        check_trained_arguments(self._arguments, stored["hyper_parameters"]["training"], checkpoint)
        if stored["global_step"] > self._last_step:
            raise Conflict(
                "run_differs",
                f"{checkpoint} was trained for {stored['global_step']} steps, but the run ends "
                f"after {self._last_step} ({len(self._sampler)} in an epoch). Give a larger "
                "--max_epochs or --max_steps, or resume from an earlier checkpoint.",
            )
        tensors = {
            name.removeprefix(STATE_DICT_PREFIX): tensor
            for name, tensor in stored["state_dict"].items()
        }
        try:
            self._run.model.load_state_dict(tensors)
        except RuntimeError as error:
            raise Conflict(
                "run_differs", f"{checkpoint} is of another network than the run: {error}"
            ) from error
        self._optimizer.load_state_dict(stored["optimizer_states"][0])
        self._precision.load_state_dict(stored["MixedPrecision"])
        self.completed_steps = self._last_saved_step = stored["global_step"]
        self._last_loss = stored["last_loss"]
        restore_rng_state(stored["rng_state"])
        history = self._run.history
        history.epochs = [each for each in history.epochs if each.step <= self.completed_steps]

    def repeat_interrupted_validation(self) -> None:
        """Validate if the run was stopped between the end of an epoch and its validation."""
        recorded = {each.step for each in self._run.history.epochs}
        if self._is_validation_due() and self.completed_steps not in recorded:
            self._validate([])

    def fit(self, loggers: Sequence[Logger]) -> None:
        """Train to the last step of the last epoch, or to `max_steps`.

        Raises RunStopped after a requested stop (`last.ckpt` holds the state after the last step),
        Unprocessable (`no_photo_decodes`, `loss_not_finite`), and what validation raises.
        """
        batches = self._load_batches()
        while self.completed_steps < self._last_step:
            self._train_epoch(loggers, batches)
        for logger in loggers:
            logger.finalize("success")

    def fit_one_step(self) -> None:
        """Train one step and save nothing, for `fast_dev_run`."""
        self._network.train()
        self._train_step(next(self._load_batches()))

    def _train_epoch(self, loggers: Sequence[Logger], batches: Iterator[Batch]) -> None:
        """Train the rest of the current epoch."""
        history = self._run.history
        # Set in each epoch: validation is in float32.
        torch.backends.cudnn.allow_tf32 = is_tf32 = self._arguments.precision != "32-true"
        torch.set_float32_matmul_precision("high" if is_tf32 else "highest")
        self._network.train()
        while True:
            started_at = time.perf_counter()
            batch = next(batches)
            history.seconds_waited += time.perf_counter() - started_at
            metrics = self._train_step(batch)
            history.seconds += time.perf_counter() - started_at
            history.images += len(batch.photos)
            self._record_undecodable(batch)
            self._show_progress(metrics)
            if self.completed_steps % self._arguments.log_every_n_steps == 0:
                self._log(loggers, metrics)
            is_epoch_end = (
                self.completed_steps % len(self._sampler) == 0
                or self.completed_steps >= self._last_step
            )
            if is_epoch_end:
                # Saved before validation, which may take long and may be interrupted.
                self._save_last()
                if self._is_validation_due():
                    self._validate(loggers)
            if self._stop.is_requested:
                self._save_last()
                self._stop.check()
            if is_epoch_end:
                return

    def _load_batches(self) -> Iterator[Batch]:
        steps = range(self.completed_steps, self._last_step)
        return load_batches(self._dataset, steps, num_workers=self._arguments.num_workers)

    def _train_step(self, batch: Batch) -> dict[str, float]:
        """Train on a batch, and return the metrics of the step."""
        if not len(batch.photos):
            raise Unprocessable(
                "no_photo_decodes",
                "None of a batch's photos can be decoded: "
                + "; ".join(p for p, _ in batch.undecodable[:3]),
            )
        pixels, labels = self._fabric.to_device((batch.photos, batch.labels))
        photos = normalise_pixels(pixels, IMAGENET_MEAN, IMAGENET_STD)
        # Losses exponentiate similarities, which overflows in half precision.
        rows = self._network(photos.contiguous(memory_format=self._memory_format)).float()
        mined = self._miner(rows, labels) if self._miner is not None else None
        loss = self._loss(rows, labels, mined)
        self._last_loss = float(loss.detach())
        if not torch.isfinite(loss):
            raise Unprocessable(
                "loss_not_finite",
                f"The loss of step {self.completed_steps} is {self._last_loss}: training has "
                "diverged. Try a smaller --lr, more --warmpup_steps or --precision 32.",
            )
        lr = learning_rate(self.completed_steps, len(self._sampler), self._arguments)
        for group in self._optimizer.param_groups:
            group["lr"] = lr
        self._optimizer.zero_grad()
        self._fabric.backward(loss)
        self._optimizer.step()
        self.completed_steps += 1
        metrics = {"loss": self._last_loss, "lr": lr}
        accuracy = batch_accuracy(self._loss, self._miner, mined, len(rows))
        if accuracy is not None:
            metrics["b_acc"] = accuracy
        return metrics

    @property
    def _epoch(self) -> int:
        """The epoch of the last completed step, from 0."""
        return (self.completed_steps - 1) // len(self._sampler)

    def _is_validation_due(self) -> bool:
        """Return whether validation follows this step: every n epochs, and after the last step."""
        every = len(self._sampler) * self._arguments.check_val_every_n_epoch
        return self.completed_steps % every == 0 or self.completed_steps >= self._last_step

    def _validate(self, loggers: Sequence[Logger]) -> None:
        """Validate, and save the checkpoint if it is one of the best."""
        history, checkpoints = self._run.history, self._run.checkpoints
        evaluations = self._validator.measure(self._run.model, self._run.validation_sets)
        if self._arguments.save_val_predictions:
            folder = self._run.folder / PREDICTIONS_FOLDER / f"epoch{self._epoch:02d}"
            write_predictions(folder, evaluations)
        metrics = flatten_recalls(evaluations)
        self._log(loggers, metrics)
        history.epochs.append(
            EpochRecord(
                number=self._epoch,
                step=self.completed_steps,
                loss=self._last_loss,
                figures=metrics,
            )
        )
        is_best = checkpoints.save_if_best(self._save, metrics, self._epoch, self.completed_steps)
        history.best = list(checkpoints.best)
        headline = "  ".join(
            f"{name} {value:.1%}"
            for name, value in metrics.items()
            if name.endswith(("/R1", "/R5"))
        )
        suffix = " (checkpoint saved)" if is_best else ""
        self._display.info(
            f"epoch {self._epoch + 1}: loss {self._last_loss:.4f}  {headline}{suffix}"
        )
        history.save(self._run.folder)

    def _log(self, loggers: Sequence[Logger], metrics: dict[str, float]) -> None:
        for logger in loggers:
            logger.log_metrics({**metrics, "epoch": self._epoch}, self.completed_steps)
            logger.save()

    def _save_last(self) -> None:
        if self._last_saved_step != self.completed_steps:
            self._run.history.save(self._run.folder)
            self._run.checkpoints.save_last(self._save)
            self._last_saved_step = self.completed_steps

    def _save(self, path: Path, weights_only: bool) -> None:
        state: dict[str, Any] = checkpoint_state(
            self._run.model, training=portable_arguments(self._arguments)
        )
        state |= {
            "epoch": self._epoch,
            "global_step": self.completed_steps,
            "last_loss": self._last_loss,
        }
        if not weights_only:
            state["optimizer_states"] = [self._optimizer.state_dict()]
            state["MixedPrecision"] = self._precision.state_dict()
            state["rng_state"] = rng_state()
        torch.save(state, path)

    def _record_undecodable(self, batch: Batch) -> None:
        bad_photos = self._run.history.bad_photos
        for path, reason in batch.undecodable:
            if path in bad_photos:
                continue
            bad_photos[path] = reason
            if len(bad_photos) <= MAX_BAD_PHOTO_WARNINGS:
                self._display.warn(f"Skipped {path}: it cannot be decoded: {reason}")
            elif len(bad_photos) == MAX_BAD_PHOTO_WARNINGS + 1:
                self._display.warn("More photos cannot be decoded; metrics.json lists all of them.")

    def _show_progress(self, metrics: dict[str, float]) -> None:
        accuracy = f"  b_acc {metrics['b_acc']:.2f}" if "b_acc" in metrics else ""
        self._display.progress(
            f"epoch {self._epoch + 1}/{self._arguments.max_epochs}",
            self.completed_steps - self._epoch * len(self._sampler),
            len(self._sampler),
            f"loss {self._last_loss:.4f}{accuracy}",
        )
