"""One run of `placewise train`, from its arguments to its summary."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from services.trainer.arguments import TrainingArguments
from services.trainer.batches import PlacePhotos, TrainingBatches
from services.trainer.checkpoint_names import NameTemplate
from services.trainer.configuration import as_plain, write_yaml
from services.trainer.device import Device, choose_device
from services.trainer.display import Display
from services.trainer.evaluation.nearest import nearest
from services.trainer.evaluation.recalls import KS
from services.trainer.fit import fit
from services.trainer.history import Epoch, History
from services.trainer.keep import KeptCheckpoints, copy_checkpoint
from services.trainer.learner import Learner
from services.trainer.loggers import check_loggers, make_loggers
from services.trainer.make_model import make_model
from services.trainer.open_data import Sets, describe_training_set, open_places, open_sets
from services.trainer.random_state import seed_everything
from services.trainer.run_folder import (
    CHECKPOINTS,
    CONFIG,
    METRICS,
    find_run,
    new_run_folder,
    resumed_arguments,
)
from services.trainer.sampling import BatchPlan
from services.trainer.stop import StopRequest
from services.trainer.summary import show_data, summarise
from services.trainer.validation import Validation, figures_of
from services.trainer.watch import Watch, is_measured_after, note_epoch
from shared.datasets.shots import TrainingSet
from shared.errors import Conflict, InvalidRequest
from shared.vision.place_models.checkpoint import load_checkpoint

Json = dict[str, Any]


@dataclass
class _Ready:
    """A run before its first step."""

    arguments: TrainingArguments
    device: Device
    places: TrainingSet
    sets: Sets
    folder: Path
    history: History
    kept: KeptCheckpoints
    resume_from: Path | None


def check_machine(arguments: TrainingArguments) -> Device:
    """The device, when all that the arguments need of this machine is there.

    Raises Misconfigured (`no_gpu`, `faiss_gpu_missing`, `logger_missing`), InvalidRequest.
    """
    device = choose_device(arguments)
    check_loggers(arguments.logger)
    if arguments.faiss_gpu:
        one = np.ones((1, 1), np.float32)
        nearest(one, one, 1, faiss_gpu=True)
    return device


def run(arguments: TrainingArguments, display: Display, stop: StopRequest) -> Json:
    """Begin a run and do its phase; what `metrics.json` holds.

    Raises RunStopped, and every error that a run's arguments or data can have.
    """
    device = check_machine(arguments)
    if arguments.experiment_phase == "test":
        return _test_only(arguments, device, display, stop)
    places, sets = open_places(arguments), open_sets(arguments)
    arguments = _as_meant(arguments, places, sets)
    if arguments.show_data_stats:
        show_data(places, sets, display)
    folder = Path() if arguments.fast_dev_run else new_run_folder(arguments)
    arguments = arguments.model_copy(update={"run_name": folder.name})
    kept = _kept(arguments, folder, sets, display)
    history = History(describe_training_set(places))
    if not arguments.fast_dev_run:
        write_yaml(arguments, folder / CONFIG)
    ready = _Ready(arguments, device, places, sets, folder, history, kept, None)
    return _learn(ready, display, stop)


def resume(path: Path, changes: Json, display: Display, stop: StopRequest) -> Json:
    """Go on with a run that was interrupted, or that is to learn longer; as `run`.

    Raises also NotFound (`run_not_found`), Conflict (`run_differs`).
    """
    folder, checkpoint = find_run(path)
    arguments = resumed_arguments(folder, changes)
    device = check_machine(arguments)
    places, sets = open_places(arguments), open_sets(arguments)
    history = History.load(folder)
    if history.training_set["fingerprint"] != places.fingerprint:
        raise Conflict(
            "run_differs",
            f"The photos below {arguments.data_root} are not those that the run in {folder} began "
            "with. Bring them back, or begin a new run (--model_path takes this one's weights).",
        )
    kept = _kept(arguments, folder, sets, display)
    kept.best = [each for each in history.best if (kept.folder / each[1]).is_file()]
    write_yaml(arguments, folder / CONFIG)
    ready = _Ready(arguments, device, places, sets, folder, history, kept, checkpoint)
    return _learn(ready, display, stop)


def _learn(ready: _Ready, display: Display, stop: StopRequest) -> Json:
    arguments, device = ready.arguments, ready.device
    seed_everything(arguments.seed)
    model = make_model(arguments, display, resuming=ready.resume_from is not None)
    learner = Learner(model, arguments, about={"training": _as_values(arguments)})
    validation = Validation(arguments, device.torch_device, display.progress, stop)
    plan = BatchPlan(
        ready.places.places,
        arguments.batch_size,
        arguments.img_per_place,
        arguments.shuffle_all,
        arguments.random_sample_from_each_place,
        arguments.reload_dataloaders_every_n_epochs,
        arguments.seed,
    )
    photos = PlacePhotos(plan, arguments.image_size, bad_is_error=arguments.on_bad_image == "error")
    batches = TrainingBatches(
        plan,
        photos,
        num_workers=arguments.num_workers,
        pin_memory=device.torch_device.type == "cuda",
    )
    watch = Watch(
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
        arguments.logger, ready.folder, as_plain(arguments)
    )  # fmt: skip
    if ready.resume_from is None:
        validation.try_out(learner.model.to(device.torch_device), ready.sets.validation)
        seed_everything(arguments.seed)
        is_over = False
    else:
        is_over = _measure_what_is_due(ready, learner, validation, display)
    if not is_over:
        fit(learner, batches, watch, arguments, device, ready.folder, loggers, ready.resume_from)
    if arguments.fast_dev_run:
        validation.measure(learner.model.to(device.torch_device), ready.sets.validation)
        display.say("One batch of everything went through; nothing was kept.")
        return {"fast_dev_run": True}
    ready.history.save(ready.folder)
    tested = {}
    if arguments.experiment_phase == "all":
        chosen = ready.kept.best_path or ready.kept.last_path
        best = load_checkpoint(chosen).model.to(device.torch_device)
        tested = validation.measure(best, ready.sets.test, for_tests=True)
    report = summarise(arguments, ready.folder, ready.history, ready.kept, ready.sets, tested)
    (ready.folder / METRICS).write_text(json.dumps(report, indent=2) + "\n")
    return report


def _measure_what_is_due(
    ready: _Ready, learner: Learner, validation: Validation, display: Display
) -> bool:
    """Take the figures of an epoch that was interrupted while it was measured; whether the run
    has all its steps."""
    assert ready.resume_from is not None
    arguments, history = ready.arguments, ready.history
    stored = torch.load(ready.resume_from, map_location="cpu", weights_only=True)
    epoch, step, epoch_done = stored["epoch"], stored["global_step"], stored["epoch_done"]
    is_over = (arguments.max_steps is not None and step >= arguments.max_steps) or (
        epoch_done and epoch + 1 >= arguments.max_epochs
    )
    history.epochs = [each for each in history.epochs if each.step <= step]
    is_due = is_over or (epoch_done and is_measured_after(epoch, arguments))
    if not is_due or any(each.step == step for each in history.epochs):
        return is_over
    learner.load_state_dict(stored["state_dict"])
    learner.model.to(ready.device.torch_device)
    found = figures_of(validation.measure(learner.model, ready.sets.validation))
    source = ready.resume_from
    note_epoch(
        Epoch(epoch, step, stored["last_loss"], found),
        history,
        ready.kept,
        lambda path, weights_only: copy_checkpoint(source, path, weights_only),
        display,
    )
    history.save(ready.folder)
    return is_over


def _test_only(
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
    sets = open_sets(arguments)
    if arguments.show_data_stats:
        show_data(None, sets, display)
    validation = Validation(arguments, device.torch_device, display.progress, stop)
    model = checkpoint.model.to(device.torch_device)
    tested = validation.measure(model, sets.test, for_tests=True)
    folder = new_run_folder(arguments)
    write_yaml(arguments, folder / CONFIG)
    report = summarise(arguments, folder, None, None, sets, tested)
    (folder / METRICS).write_text(json.dumps(report, indent=2) + "\n")
    return report


def _as_meant(arguments: TrainingArguments, places: TrainingSet, sets: Sets) -> TrainingArguments:
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


def _kept(
    arguments: TrainingArguments, folder: Path, sets: Sets, display: Display
) -> KeptCheckpoints:
    metrics = [f"{each.name}/R{k}" for each in sets.validation for k in KS]
    if not metrics:
        display.warn("There is no set to validate on: only last.ckpt is kept.")
    elif arguments.monitor not in metrics:
        raise InvalidRequest(
            "unknown_metric",
            f"--monitor {arguments.monitor} is not measured in this run; known: "
            f"{', '.join(metrics)}.",
        )
    name = NameTemplate(
        arguments.filename,
        as_plain(arguments),
        metrics,
        monitored=arguments.monitor.rpartition("/")[0],
        insert_names=arguments.auto_insert_metric_name,
    )
    for dropped in name.dropped if metrics else ():
        display.warn(f"--filename: no run on these sets logs {dropped}; it drops out of the names.")
    return KeptCheckpoints(
        folder / CHECKPOINTS,
        name,
        arguments.monitor,
        arguments.mode,
        arguments.save_top_k,
        arguments.save_weights_only,
    )


def _as_values(arguments: TrainingArguments) -> Json:
    """What a checkpoint says of its training; no paths of this machine."""
    plain = as_plain(arguments)
    for name in ("data_root", "eval_roots", "weights", "model_path", "default_root_dir"):
        plain.pop(name)
    return plain
