"""One run of `placewise train`, from its arguments to its summary.

Lightning's part of a run: its trainer, as quiet and as repeatable as a run wants it.
"""

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


Json = dict[str, Any]


@dataclass
class _PreparedRun:
    """A run before its first step."""

    arguments: TrainingArguments
    device: Device
    places: TrainingSet
    sets: EvaluationSets
    model: VprModel
    folder: Path
    history: TrainingHistory
    kept: TopKCheckpoints
    resume_from: Path | None


def run(arguments: TrainingArguments, display: Display, stop: StopRequest) -> Json:
    """Begin a run and do its phase; what `metrics.json` holds.

    Raises RunStopped, and every error that a run's arguments or data can have.
    """
    device = check_environment(arguments)
    if arguments.experiment_phase == "test":
        return _run_test_phase(arguments, device, display, stop)
    places, sets = select_training_set(arguments), select_evaluation_sets(arguments)
    arguments = resolve_arguments(arguments, places, sets)
    if arguments.show_data_stats:
        print_data_sets(places, sets, display)
    seed_everything(arguments.seed)
    model = make_model(arguments, display, resuming=False)
    folder = Path() if arguments.fast_dev_run else create_run_folder(arguments)
    arguments = arguments.model_copy(update={"run_name": folder.name})
    kept = make_checkpoints(arguments, folder, sets, display)
    history = TrainingHistory(summarise_training_set(places))
    if not arguments.fast_dev_run:
        save_yaml(arguments, folder / CONFIG_FILE)
    ready = _PreparedRun(arguments, device, places, sets, model, folder, history, kept, None)
    return _run_until_stopped(ready, display, stop)


def resume(path: Path, changes: Json, display: Display, stop: StopRequest) -> Json:
    """Go on with a run that was interrupted, or that is to learn longer; as `run`.

    Raises also NotFound (`run_not_found`), Conflict (`run_differs`).
    """
    folder, checkpoint = find_run(path)
    arguments = load_resumed_arguments(folder, changes)
    device = check_environment(arguments)
    places, history = select_training_set(arguments), TrainingHistory.load(folder)
    if history.training_set["fingerprint"] != places.fingerprint:
        raise Conflict(
            "run_differs",
            f"The photos below {arguments.data_root} are not those that the run in {folder} began "
            "with. Bring them back, or begin a new run (--model_path takes this one's weights).",
        )
    sets = select_evaluation_sets(arguments)
    kept = make_checkpoints(arguments, folder, sets, display)
    kept.best = [each for each in history.best if (kept.folder / each[1]).is_file()]
    model = make_model(arguments, display, resuming=True)
    save_yaml(arguments, folder / CONFIG_FILE)
    ready = _PreparedRun(arguments, device, places, sets, model, folder, history, kept, checkpoint)
    return _run_until_stopped(ready, display, stop)


def _run_until_stopped(ready: _PreparedRun, display: Display, stop: StopRequest) -> Json:
    try:
        return _train(ready, display, stop)
    except RunStopped:
        if not ready.kept.last_path.is_file():
            raise RunStopped(
                "Stopped before the first step: there is nothing to go on from."
            ) from None
        raise RunStopped(
            f"Stopped. {ready.kept.last_path} holds everything; go on with\n"
            f"  placewise train --resume {shlex.quote(str(ready.folder))}"
        ) from None


def _train(ready: _PreparedRun, display: Display, stop: StopRequest) -> Json:
    arguments, device = ready.arguments, ready.device
    learner = MetricLearningModule(
        ready.model, arguments, metadata={"training": portable_arguments(arguments)}
    )
    validation = Validator(arguments, device.torch_device, display.progress, stop)
    plan = PlaceBatchSampler(
        ready.places.places,
        arguments.batch_size,
        arguments.img_per_place,
        arguments.shuffle_all,
        arguments.random_sample_from_each_place,
        arguments.reload_dataloaders_every_n_epochs,
        arguments.seed,
    )
    photos = PlaceDataset(
        plan,
        arguments.image_size,
        augment=arguments.augmentation == "randaugment",
        fail_on_undecodable=arguments.on_bad_image == "error",
    )
    batches = ResumableDataLoader(
        plan,
        photos,
        num_workers=arguments.num_workers,
        pin_memory=device.torch_device.type == "cuda",
    )
    watch = TrainingCallback(
        arguments,
        ready.folder,
        batches,
        ready.sets.validation,
        validation,
        ready.kept,
        ready.history,
        stop,
        display,
    )
    loggers = [] if arguments.fast_dev_run else make_loggers(
        arguments.logger, ready.folder, to_plain_dict(arguments)
    )  # fmt: skip
    if ready.resume_from is None:
        validation.sanity_check(
            learner.model.to(device.torch_device),
            ready.sets.validation,
            arguments.num_sanity_val_steps,
        )
        seed_everything(arguments.seed)
        is_over = False
    else:
        is_over = _finish_interrupted_validation(ready, learner, validation, display)
    if not is_over:
        fit(learner, batches, watch, arguments, device, ready.folder, loggers, ready.resume_from)
    if arguments.fast_dev_run:
        validation.sanity_check(learner.model.to(device.torch_device), ready.sets.validation, 1)
        display.info("One batch of everything went through; nothing was kept.")
        return {"fast_dev_run": True}
    ready.history.save(ready.folder)
    tested = {}
    if arguments.experiment_phase == "all":
        chosen = ready.kept.best_path or ready.kept.last_path
        best = load_checkpoint(chosen).model.to(device.torch_device)
        tested = validation.measure(best, ready.sets.test, for_tests=True)
    report = build_summary(arguments, ready.folder, ready.history, ready.kept, ready.sets, tested)
    (ready.folder / METRICS_FILE).write_text(json.dumps(report, indent=2) + "\n")
    return report


def _finish_interrupted_validation(
    ready: _PreparedRun, learner: MetricLearningModule, validation: Validator, display: Display
) -> bool:
    """Take the figures of an epoch that was interrupted while it was measured; whether the run
    has all its steps."""
    assert ready.resume_from is not None
    arguments, history = ready.arguments, ready.history
    stored = torch.load(ready.resume_from, map_location="cpu", weights_only=True)
    epoch, step, epoch_done = stored["epoch"], stored["global_step"], stored["epoch_done"]
    is_over: bool = (arguments.max_steps is not None and step >= arguments.max_steps) or (
        epoch_done and epoch + 1 >= arguments.max_epochs
    )
    history.epochs = [each for each in history.epochs if each.step <= step]
    is_due = is_over or (epoch_done and is_validation_epoch(epoch, arguments))
    if not is_due or any(each.step == step for each in history.epochs):
        return is_over
    learner.load_state_dict(stored["state_dict"])
    learner.model.to(ready.device.torch_device)
    found = flatten_recalls(validation.measure(learner.model, ready.sets.validation))
    source = ready.resume_from
    record_epoch(
        EpochRecord(epoch, step, stored["last_loss"], found),
        history,
        ready.kept,
        lambda path, weights_only: copy_checkpoint(source, path, weights_only),
        display,
    )
    history.save(ready.folder)
    return is_over


def _run_test_phase(
    arguments: TrainingArguments, device: Device, display: Display, stop: StopRequest
) -> Json:
    if arguments.model_path is None:
        raise InvalidRequest(
            "model_path_missing",
            "--experiment_phase test needs --model_path: the checkpoint that is tested.",
        )
    checkpoint = load_checkpoint(arguments.model_path)
    if "image_size" not in arguments.model_fields_set:
        arguments = arguments.model_copy(update={"image_size": checkpoint.config.image_size})
    sets = select_evaluation_sets(arguments)
    if arguments.show_data_stats:
        print_data_sets(None, sets, display)
    validation = Validator(arguments, device.torch_device, display.progress, stop)
    model = checkpoint.model.to(device.torch_device)
    tested = validation.measure(model, sets.test, for_tests=True)
    folder = create_run_folder(arguments)
    save_yaml(arguments, folder / CONFIG_FILE)
    report = build_summary(arguments, folder, None, None, sets, tested)
    (folder / METRICS_FILE).write_text(json.dumps(report, indent=2) + "\n")
    return report
