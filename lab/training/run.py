"""Runs and resumes one training run, from its arguments to `metrics.json`."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from lightning.fabric import seed_everything

from lab.evaluation.ranking import RecallEvaluation
from lab.training.arguments import TrainingArguments, combine_obstacles, save_yaml, to_plain_dict
from lab.training.data import EvaluationSets, select_evaluation_sets, select_training_set
from lab.training.model_factory import make_model, register_own_modules
from lab.training.resolve import (
    check_environment,
    check_loggers,
    list_changed_meanings,
    make_checkpoints,
    make_fabric,
    make_loggers,
    resolve_arguments,
)
from lab.training.run_control import Display, NullDisplay, RunStopped, StopRequest
from lab.training.run_folder import (
    CONFIG_FILE,
    METRICS_FILE,
    TrainingHistory,
    TrainingSetSummary,
    create_run_folder,
    find_run,
    load_resumed_arguments,
    lock_folder,
)
from lab.training.summary import build_summary, print_data_sets
from lab.training.training_loop import TrainingLoop, TrainingRun
from lab.training.validation import Validator, write_predictions
from shared.config.command_line import command_line
from shared.descriptors.vpr_models.checkpoint import Checkpoint, load_checkpoint
from shared.errors import Conflict, InvalidRequest, PlacewiseError

Json = dict[str, Any]


def find_obstacles(arguments: TrainingArguments) -> list[PlacewiseError]:
    """Return every reason for which a run can't start on this machine, each once.

    Checks the device, the loggers, the data sets, own modules and the network; missing pretrained
    weights are downloaded if possible.
    """
    checks: list[Callable[[], object]] = [
        lambda: make_fabric(arguments),
        lambda: check_loggers(arguments.logger),
        lambda: register_own_modules(arguments),
        lambda: select_evaluation_sets(arguments),
    ]
    if arguments.experiment_phase == "test":
        checks.append(lambda: _load_tested(arguments))
    else:
        checks.append(lambda: select_training_set(arguments))
        checks.append(lambda: make_model(arguments, NullDisplay(), resuming=False))
    obstacles: dict[str, PlacewiseError] = {}
    for check in checks:
        try:
            check()
        except PlacewiseError as error:
            obstacles.setdefault(error.detail, error)
    return list(obstacles.values())


@contextlib.contextmanager
def _listing_all_obstacles(arguments: TrainingArguments) -> Iterator[None]:
    """Replace the first error of the start by one that lists all obstacles."""
    try:
        register_own_modules(arguments)
        yield
    except PlacewiseError as error:
        obstacles = find_obstacles(arguments)
        if all(each.detail != error.detail for each in obstacles):
            obstacles.insert(0, error)
        if len(obstacles) == 1:
            raise
        raise combine_obstacles(obstacles) from error


def run(arguments: TrainingArguments, display: Display, stop: StopRequest) -> Json:
    """Start a run and execute its phase: train, test, or all.

    Returns the content of `metrics.json`; `{"fast_dev_run": True}` for a fast development run.
    Raises RunStopped, whose message says how to resume, and every error of arguments and data.
    """
    if arguments.experiment_phase == "test":
        return _run_test_phase(arguments, display, stop)
    with _listing_all_obstacles(arguments):
        fabric = check_environment(arguments, display)
        training_set, sets = select_training_set(arguments), select_evaluation_sets(arguments)
        arguments = resolve_arguments(arguments, training_set, sets)
        if arguments.show_data_stats:
            print_data_sets(training_set, sets, display)
        for note in list_changed_meanings(arguments):
            display.info(note)
        seed_everything(arguments.seed, verbose=False)
        model = make_model(arguments, display, resuming=False)
    folder = Path() if arguments.fast_dev_run else create_run_folder(arguments)
    arguments = arguments.model_copy(update={"run_name": folder.name})
    checkpoints = make_checkpoints(arguments, folder, sets, display)
    history = TrainingHistory(
        training_set=TrainingSetSummary(
            name=training_set.name,
            layout=training_set.layout,
            cities=list(training_set.cities),
            places=len(training_set.places),
            photos=training_set.photo_count,
            fingerprint=training_set.fingerprint,
        )
    )
    if not arguments.fast_dev_run:
        save_yaml(arguments, folder / CONFIG_FILE)
    prepared = TrainingRun(
        arguments, fabric, training_set, sets.validation, model, folder, history, checkpoints
    )
    with contextlib.nullcontext() if arguments.fast_dev_run else lock_folder(folder):
        return _train(prepared, sets, display, stop)


def resume(path: Path, changes: Json, display: Display, stop: StopRequest) -> Json:
    """Resume an interrupted run, or continue a finished one for more epochs.

    `path` is the run's folder, or one of its checkpoints with the full state; `changes` are
    arguments that override the stored ones. Returns the content of `metrics.json`.

    Raises:
        NotFound: `run_not_found`.
        Conflict: `run_differs`, for changed photos or a change that `--resume` does not allow;
            `run_in_use`, while another process trains it.
        Unprocessable: `run_unreadable`, `checkpoint_unreadable`. Also raises what `run` raises.
    """
    folder, checkpoint = find_run(path)
    with lock_folder(folder):
        return _resume(folder, checkpoint, changes, display, stop)


def _resume(
    folder: Path, checkpoint: Path, changes: Json, display: Display, stop: StopRequest
) -> Json:
    arguments = load_resumed_arguments(folder, changes)
    if arguments.experiment_phase == "test":
        raise InvalidRequest(
            "bad_argument",
            "--resume continues training. Test a checkpoint with --experiment_phase test "
            "--model_path CHECKPOINT.",
        )
    register_own_modules(arguments)
    fabric = check_environment(arguments, display)
    training_set, history = select_training_set(arguments), TrainingHistory.load(folder)
    if history.training_set.fingerprint != training_set.fingerprint:
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
    prepared = TrainingRun(
        arguments, fabric, training_set, sets.validation, model, folder, history, checkpoints
    )
    return _train(prepared, sets, display, stop, resume_from=checkpoint)


def _train(
    prepared: TrainingRun,
    sets: EvaluationSets,
    display: Display,
    stop: StopRequest,
    resume_from: Path | None = None,
) -> Json:
    arguments, folder, checkpoints = prepared.arguments, prepared.folder, prepared.checkpoints
    device = prepared.fabric.device
    validator = Validator(arguments, device, display.progress, stop)
    loop = TrainingLoop(prepared, validator, display, stop)
    try:
        if resume_from is None:
            batches = arguments.num_sanity_val_steps
            validator.sanity_check(prepared.model, sets.validation, batches)
            seed_everything(arguments.seed, verbose=False)
        else:
            loop.restore(resume_from)
        if arguments.fast_dev_run:
            loop.fit_one_step()
            validator.sanity_check(prepared.model, sets.validation, 1)
            display.info("One batch of training and validation succeeded; no files were written.")
            return {"fast_dev_run": True}
        if resume_from is not None:
            save_yaml(arguments, folder / CONFIG_FILE)
            loop.repeat_interrupted_validation()
        loop.fit(
            make_loggers(arguments.logger, folder, to_plain_dict(arguments), loop.completed_steps)
        )
        prepared.history.save(folder)
        tests: dict[str, RecallEvaluation] = {}
        if arguments.experiment_phase == "all":
            best_path = checkpoints.best_path or checkpoints.last_path
            best = load_checkpoint(best_path).model.to(device)
            tests = validator.measure(best, sets.test, for_tests=True)
            write_predictions(folder, tests)
    except RunStopped:
        if not checkpoints.last_path.is_file():
            raise RunStopped(
                "Stopped before the first step: there is no checkpoint to resume from."
            ) from None
        raise RunStopped(
            f"Stopped. {checkpoints.last_path} holds the full training state; resume with\n"
            f"  {command_line('train', '--resume', folder)}"
        ) from None
    report = build_summary(arguments, folder, prepared.history, checkpoints, sets, tests)
    (folder / METRICS_FILE).write_text(json.dumps(report, indent=2) + "\n")
    return report


def _load_tested(arguments: TrainingArguments) -> Checkpoint:
    if arguments.model_path is None:
        raise InvalidRequest(
            "model_path_missing",
            "--experiment_phase test requires --model_path, the checkpoint to test.",
        )
    return load_checkpoint(arguments.model_path)


def _run_test_phase(arguments: TrainingArguments, display: Display, stop: StopRequest) -> Json:
    with _listing_all_obstacles(arguments):
        fabric = check_environment(arguments, display)
        checkpoint = _load_tested(arguments)
        if "image_size" not in arguments.model_fields_set:
            trained = checkpoint.config.model_dump(include={"image_size", "interpolation"})
            arguments = arguments.model_copy(update=trained)
        sets = select_evaluation_sets(arguments)
    if arguments.show_data_stats:
        print_data_sets(None, sets, display)
    for note in list_changed_meanings(arguments):
        display.info(note)
    validator = Validator(arguments, fabric.device, display.progress, stop)
    model = checkpoint.model.to(fabric.device)
    tests = validator.measure(model, sets.test, for_tests=True)
    folder = create_run_folder(arguments)
    write_predictions(folder, tests)
    save_yaml(arguments, folder / CONFIG_FILE)
    report = build_summary(arguments, folder, None, None, sets, tests)
    (folder / METRICS_FILE).write_text(json.dumps(report, indent=2) + "\n")
    return report
