"""Runs and resumes one training run, from its arguments to `metrics.json`."""

from __future__ import annotations

import json
import logging
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.loggers import Logger

from services.trainer.arguments import TrainingArguments, save_yaml, to_plain_dict
from services.trainer.callbacks import (
    TrainingCallback,
    Validator,
    flatten_recalls,
    is_validation_epoch,
    record_epoch,
)
from services.trainer.checkpointing import TopKCheckpoints, copy_checkpoint, seed_everything
from services.trainer.data import PlaceBatchSampler, PlaceDataset, ResumableDataLoader
from services.trainer.dataset_selection import (
    EvaluationSets,
    select_evaluation_sets,
    select_training_set,
    summarise_training_set,
)
from services.trainer.module import MetricLearningModule, make_model
from services.trainer.resolve import (
    Device,
    check_environment,
    make_checkpoints,
    make_loggers,
    portable_arguments,
    resolve_arguments,
)
from services.trainer.run_control import Display, RunStopped, StopRequest
from services.trainer.run_folder import (
    CONFIG_FILE,
    METRICS_FILE,
    EpochRecord,
    TrainingHistory,
    create_run_folder,
    find_run,
    load_resumed_arguments,
)
from services.trainer.summary import build_summary, print_data_sets
from shared.datasets.dataset import TrainingSet
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.model import VprModel
from shared.errors import Conflict, InvalidRequest


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
    """Train with Lightning, from the start or from a checkpoint with the full state.

    The callback validates and saves checkpoints; Lightning's own validation, checkpointing and
    progress bar are disabled.

    Args:
        module: the network with loss and miner.
        batches: the training data.
        callback: validates, saves checkpoints and stops the run.
        arguments: number of epochs and logging interval; the callback ends at `max_steps`.
        device: accelerator, device index and precision.
        folder: the run's folder.
        loggers: Lightning loggers; may be empty.
        resume_from: `last.ckpt` of an interrupted run, or None.

    Raises:
        RunStopped: a stop was requested; also raises what training steps raise.
    """
    # Hide Lightning's tips, such as its advice on the number of workers.
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"lightning\.")
        trainer = lightning.Trainer(
            accelerator=device.accelerator,
            devices=device.devices,
            precision=device.precision,
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


Json = dict[str, Any]


@dataclass
class _PreparedRun:
    """Everything that a run needs before its first step."""

    arguments: TrainingArguments
    device: Device
    training_set: TrainingSet
    sets: EvaluationSets
    model: VprModel
    folder: Path
    history: TrainingHistory
    checkpoints: TopKCheckpoints
    resume_from: Path | None


def run(arguments: TrainingArguments, display: Display, stop: StopRequest) -> Json:
    """Start a run and execute its phase: train, test, or all.

    Args:
        arguments: the run's arguments.
        display: receives messages and progress.
        stop: requests a graceful stop.

    Returns:
        The content of `metrics.json`; `{"fast_dev_run": True}` for a fast development run.

    Raises:
        RunStopped: a stop was requested; the message says how to resume. Also raises every error
            of arguments and data.
    """
    device = check_environment(arguments)
    if arguments.experiment_phase == "test":
        return _run_test_phase(arguments, device, display, stop)
    training_set, sets = select_training_set(arguments), select_evaluation_sets(arguments)
    arguments = resolve_arguments(arguments, training_set, sets)
    if arguments.show_data_stats:
        print_data_sets(training_set, sets, display)
    seed_everything(arguments.seed)
    model = make_model(arguments, display, resuming=False)
    folder = Path() if arguments.fast_dev_run else create_run_folder(arguments)
    arguments = arguments.model_copy(update={"run_name": folder.name})
    checkpoints = make_checkpoints(arguments, folder, sets, display)
    history = TrainingHistory(summarise_training_set(training_set))
    if not arguments.fast_dev_run:
        save_yaml(arguments, folder / CONFIG_FILE)
    prepared = _PreparedRun(
        arguments, device, training_set, sets, model, folder, history, checkpoints, None
    )
    return _run_until_stopped(prepared, display, stop)


def resume(path: Path, changes: Json, display: Display, stop: StopRequest) -> Json:
    """Resume an interrupted run, or continue a finished one for more epochs.

    Args:
        path: the run's folder, or one of its checkpoints with the full state.
        changes: arguments that override the stored ones.
        display: receives messages and progress.
        stop: requests a graceful stop.

    Returns:
        The content of `metrics.json`.

    Raises:
        NotFound: `run_not_found`.
        Conflict: `run_differs`, for changed photos or a change that `--resume` does not allow. Also
            raises what `run` raises.
    """
    folder, checkpoint = find_run(path)
    arguments = load_resumed_arguments(folder, changes)
    device = check_environment(arguments)
    training_set, history = select_training_set(arguments), TrainingHistory.load(folder)
    if history.training_set["fingerprint"] != training_set.fingerprint:
        raise Conflict(
            "run_differs",
            f"The photos in {arguments.data_root} are not those that the run in {folder} was "
            "started with. Restore them, or start a new run (--model_path takes this run's "
            "weights).",
        )
    sets = select_evaluation_sets(arguments)
    checkpoints = make_checkpoints(arguments, folder, sets, display)
    checkpoints.best = [
        (score, name) for score, name in history.best if (checkpoints.folder / name).is_file()
    ]
    model = make_model(arguments, display, resuming=True)
    save_yaml(arguments, folder / CONFIG_FILE)
    prepared = _PreparedRun(
        arguments, device, training_set, sets, model, folder, history, checkpoints, checkpoint
    )
    return _run_until_stopped(prepared, display, stop)


def _run_until_stopped(prepared: _PreparedRun, display: Display, stop: StopRequest) -> Json:
    try:
        return _train(prepared, display, stop)
    except RunStopped:
        last_path = prepared.checkpoints.last_path
        if not last_path.is_file():
            raise RunStopped(
                "Stopped before the first step: there is no checkpoint to resume from."
            ) from None
        raise RunStopped(
            f"Stopped. {last_path} holds the full training state; resume with\n"
            f"  placewise train --resume {shlex.quote(str(prepared.folder))}"
        ) from None


def _train(prepared: _PreparedRun, display: Display, stop: StopRequest) -> Json:
    arguments, device = prepared.arguments, prepared.device
    module = MetricLearningModule(
        prepared.model, arguments, metadata={"training": portable_arguments(arguments)}
    )
    validator = Validator(arguments, device.torch_device, display.progress, stop)
    sampler = PlaceBatchSampler(
        prepared.training_set.places,
        arguments.batch_size,
        arguments.img_per_place,
        arguments.shuffle_all,
        arguments.random_sample_from_each_place,
        arguments.reload_dataloaders_every_n_epochs,
        arguments.seed,
    )
    dataset = PlaceDataset(
        sampler,
        arguments.image_size,
        augment=arguments.augmentation == "randaugment",
        fail_on_undecodable=arguments.on_bad_image == "error",
    )
    batches = ResumableDataLoader(
        sampler,
        dataset,
        num_workers=arguments.num_workers,
        pin_memory=device.torch_device.type == "cuda",
    )
    folder, sets, checkpoints = prepared.folder, prepared.sets, prepared.checkpoints
    callback = TrainingCallback(
        arguments,
        folder,
        batches,
        sets.validation,
        validator,
        checkpoints,
        prepared.history,
        stop,
        display,
    )
    loggers = [] if arguments.fast_dev_run else make_loggers(
        arguments.logger, folder, to_plain_dict(arguments)
    )  # fmt: skip
    if prepared.resume_from is None:
        validator.sanity_check(
            module.model.to(device.torch_device), sets.validation, arguments.num_sanity_val_steps
        )
        seed_everything(arguments.seed)
        is_complete = False
    else:
        is_complete = _finish_interrupted_validation(prepared, module, validator, display)
    if not is_complete:
        fit(module, batches, callback, arguments, device, folder, loggers, prepared.resume_from)
    if arguments.fast_dev_run:
        validator.sanity_check(module.model.to(device.torch_device), sets.validation, 1)
        display.info("One batch of training and validation succeeded; no files were written.")
        return {"fast_dev_run": True}
    prepared.history.save(folder)
    test_recalls = {}
    if arguments.experiment_phase == "all":
        best_path = checkpoints.best_path or checkpoints.last_path
        best = load_checkpoint(best_path).model.to(device.torch_device)
        test_recalls = validator.measure(best, sets.test, for_tests=True)
    report = build_summary(arguments, folder, prepared.history, checkpoints, sets, test_recalls)
    (folder / METRICS_FILE).write_text(json.dumps(report, indent=2) + "\n")
    return report


def _finish_interrupted_validation(
    prepared: _PreparedRun, module: MetricLearningModule, validator: Validator, display: Display
) -> bool:
    """Repeat a validation that was interrupted; return whether the run has all its steps."""
    assert prepared.resume_from is not None
    arguments, history = prepared.arguments, prepared.history
    stored = torch.load(prepared.resume_from, map_location="cpu", weights_only=True)
    epoch, step, epoch_done = stored["epoch"], stored["global_step"], stored["epoch_done"]
    is_complete: bool = (arguments.max_steps is not None and step >= arguments.max_steps) or (
        epoch_done and epoch + 1 >= arguments.max_epochs
    )
    history.epochs = [each for each in history.epochs if each.step <= step]
    is_due = is_complete or (epoch_done and is_validation_epoch(epoch, arguments))
    if not is_due or any(each.step == step for each in history.epochs):
        return is_complete
    module.load_state_dict(stored["state_dict"])
    module.model.to(prepared.device.torch_device)
    metrics = flatten_recalls(validator.measure(module.model, prepared.sets.validation))
    source = prepared.resume_from
    record_epoch(
        EpochRecord(epoch, step, stored["last_loss"], metrics),
        history,
        prepared.checkpoints,
        lambda path, weights_only: copy_checkpoint(source, path, weights_only),
        display,
    )
    history.save(prepared.folder)
    return is_complete


def _run_test_phase(
    arguments: TrainingArguments, device: Device, display: Display, stop: StopRequest
) -> Json:
    if arguments.model_path is None:
        raise InvalidRequest(
            "model_path_missing",
            "--experiment_phase test requires --model_path, the checkpoint to test.",
        )
    checkpoint = load_checkpoint(arguments.model_path)
    if "image_size" not in arguments.model_fields_set:
        arguments = arguments.model_copy(update={"image_size": checkpoint.config.image_size})
    sets = select_evaluation_sets(arguments)
    if arguments.show_data_stats:
        print_data_sets(None, sets, display)
    validator = Validator(arguments, device.torch_device, display.progress, stop)
    model = checkpoint.model.to(device.torch_device)
    test_recalls = validator.measure(model, sets.test, for_tests=True)
    folder = create_run_folder(arguments)
    save_yaml(arguments, folder / CONFIG_FILE)
    report = build_summary(arguments, folder, None, None, sets, test_recalls)
    (folder / METRICS_FILE).write_text(json.dumps(report, indent=2) + "\n")
    return report
