"""Grid search: plans training runs from a YAML file and executes them sequentially.

Finished runs are skipped, interrupted runs are resumed, failed runs are retried. The format:

    base: {lr: 0.0002}                   # arguments of every run
    grid:                                # Cartesian product
      agg_arch: [AVG, GeM]
      loss: [{loss_name: NTXentLoss}, {loss_name: FastAPLoss, miner_name: AngularMiner}]
    runs:                                # additional single runs
      - {name: baseline, agg_arch: GeM, published: {sfxs_val/R1: 63.59}}
    fingerprints: {sfxs_val: 0123...}    # of the sets that published results were measured on

A value that is a mapping sets several arguments; the name of its axis is then only a label.
"""

from __future__ import annotations

import itertools
import json
import shutil
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from services.trainer.arguments import (
    build_arguments,
    load_mapping,
    load_yaml,
    resolve_keys,
    resolve_name,
    suggest_name,
    to_plain_dict,
)
from services.trainer.checkpointing import LAST_CHECKPOINT, safe_filename
from services.trainer.losses import make_loss
from services.trainer.miners import make_miner
from services.trainer.model_factory import build_model_config
from services.trainer.run_control import Display, RunStopped, StopRequest
from services.trainer.run_folder import CHECKPOINTS_FOLDER, CONFIG_FILE, METRICS_FILE
from shared.errors import Conflict, InvalidRequest, PlacewiseError

GRID_KEYS = ("base", "grid", "runs", "fingerprints")
RESERVED_ARGUMENTS = ("default_root_dir", "run_name")
"""Arguments that the grid sets for each run"""


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """A run of a grid: its name and its arguments."""

    name: str
    arguments: dict[str, Any]
    published: dict[str, float] = field(default_factory=dict)
    """SET/R1 -> published result of these settings, in per cent"""


@dataclass(frozen=True, slots=True)
class GridPlan:
    """The runs of a grid."""

    runs: tuple[PlannedRun, ...]
    fingerprints: dict[str, str]
    """set name -> fingerprint of the set that published results were measured on; may be empty"""


def load_grid_plan(path: Path, overrides: Mapping[str, Any]) -> GridPlan:
    """Load a grid from a YAML file and validate the arguments of all runs.

    Args:
        path: the YAML file.
        overrides: arguments that override those of every run.

    Raises:
        NotFound: `config_not_found`.
        InvalidRequest: `bad_grid`, `unknown_argument`, `bad_argument`. Also raises the errors of
            an unknown backbone, aggregator, loss or miner.
    """
    stored = load_mapping(path)
    for key in stored:
        if key not in GRID_KEYS:
            raise _grid_error(path, f"there is no key {key!r}.{suggest_name(key, GRID_KEYS)}")
    base = resolve_keys(_require_mapping(path, "base", stored.get("base")), f"{path}, base")
    runs = [
        _plan_run(path, name, {**base, **arguments, **overrides}, published)
        for name, arguments, published in (
            *_expand_grid(path, _require_mapping(path, "grid", stored.get("grid"))),
            *_listed_runs(path, stored.get("runs") or []),
        )
    ]
    if not runs:
        raise _grid_error(path, "it has neither `grid` nor `runs`: there is nothing to train")
    names = [run.name for run in runs]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise _grid_error(
            path, f"several runs are called {', '.join(duplicates)}; run names must be unique"
        )
    fingerprints = _require_mapping(path, "fingerprints", stored.get("fingerprints"))
    return GridPlan(tuple(runs), {name: str(value) for name, value in fingerprints.items()})


def _expand_grid(path: Path, axes: dict[str, Any]) -> list[tuple[str, dict[str, Any], Any]]:
    options: list[list[tuple[str, dict[str, Any]]]] = []
    for axis, values in axes.items():
        if not isinstance(values, list) or not values:
            raise _grid_error(path, f"grid, {axis}: must be a list of values")
        options.append([_axis_option(path, axis, value) for value in values])
    runs: list[tuple[str, dict[str, Any], Any]] = []
    for combination in itertools.product(*options) if options else ():
        arguments: dict[str, Any] = {}
        for _, values in combination:
            arguments |= values
        runs.append(("-".join(label for label, _ in combination), arguments, {}))
    return runs


def _axis_option(path: Path, axis: str, value: Any) -> tuple[str, dict[str, Any]]:
    if isinstance(value, dict):
        arguments = resolve_keys(value, f"{path}, grid, {axis}")
        label = "-".join(
            str(each) for each in arguments.values() if not isinstance(each, (dict, list))
        )
        return label or axis, arguments
    return str(value), {resolve_name(axis): value}


def _listed_runs(path: Path, runs: Any) -> list[tuple[str, dict[str, Any], Any]]:
    listed = []
    for number, entry in enumerate(runs if isinstance(runs, list) else [runs], start=1):
        values = dict(_require_mapping(path, f"runs, {number}", entry))
        name = str(values.pop("name", f"{number:02d}"))
        published = _require_mapping(path, f"{name}, published", values.pop("published", None))
        listed.append((name, resolve_keys(values, f"{path}, runs, {name}"), published))
    return listed


def _plan_run(path: Path, name: str, values: dict[str, Any], published: Any) -> PlannedRun:
    reserved = [key for key in RESERVED_ARGUMENTS if key in values]
    if reserved:
        raise _grid_error(
            path, f"{', '.join(reserved)} cannot be set: each run has its folder in --out"
        )
    try:
        arguments = build_arguments(values)
        build_model_config(arguments)
        make_loss(arguments.loss_name)
        make_miner(arguments.miner_name, arguments.miner_margin)
        published_metrics = {str(key): float(value) for key, value in published.items()}
    except PlacewiseError as error:
        raise type(error)(error.code, f"{path}, {name}: {error.detail}") from error
    except (TypeError, ValueError) as error:
        raise _grid_error(path, f"{name}, published: values must be numbers") from error
    return PlannedRun(safe_filename(name), values, published_metrics)


def _require_mapping(path: Path, location: str, value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise _grid_error(path, f"{location}: must be a mapping of names to values")
    return value


def _grid_error(path: Path, detail: str) -> InvalidRequest:
    return InvalidRequest("bad_grid", f"{path}: {detail}.")


FAILED_FILE = "failed.json"

Json = dict[str, Any]


class RunState(StrEnum):
    """State of a run, determined from the files in its folder."""

    FINISHED = "finished"
    """has metrics.json"""
    INTERRUPTED = "interrupted"
    """has last.ckpt and can be resumed"""
    FAILED = "failed"
    """ended with an error; will be retried"""
    WAITING = "waiting"
    """has not completed a step"""


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """State of a run, with its report or its error."""

    run: PlannedRun
    state: RunState
    report: Json | None = None
    """`metrics.json` of a finished run"""
    error: Json | None = None
    """`code` and `detail` of a failed run"""


@dataclass(frozen=True, slots=True)
class RunFunctions:
    """Functions that start and resume a run: `run` and `resume` of `services.trainer.run`."""

    begin: Callable[..., Json]
    resume: Callable[..., Json]


def load_outcome(planned: PlannedRun, out: Path) -> RunOutcome:
    """Determine the state of a planned run from its folder below `out`.

    Raises:
        Conflict: `grid_run_differs`, if the folder's run has other arguments.
    """
    folder = out / planned.name
    if (folder / CONFIG_FILE).is_file():
        _check_same_arguments(planned, folder)
    if (folder / METRICS_FILE).is_file():
        report = json.loads((folder / METRICS_FILE).read_text())
        return RunOutcome(planned, RunState.FINISHED, report=report)
    if (folder / FAILED_FILE).is_file():
        return RunOutcome(
            planned, RunState.FAILED, error=json.loads((folder / FAILED_FILE).read_text())
        )
    if (folder / CHECKPOINTS_FOLDER / LAST_CHECKPOINT).is_file():
        return RunOutcome(planned, RunState.INTERRUPTED)
    return RunOutcome(planned, RunState.WAITING)


def run_grid(
    plan: GridPlan,
    out: Path,
    trainer: RunFunctions,
    display: Display,
    stop: StopRequest,
    after_each: Callable[[list[RunOutcome]], None],
) -> list[RunOutcome]:
    """Execute all unfinished runs sequentially. A failed run does not stop the others.

    Args:
        plan: the runs.
        out: root folder of the runs.
        trainer: functions that start and resume a run.
        display: receives messages and progress.
        stop: requests a graceful stop.
        after_each: called with all outcomes after each run.

    Returns:
        The outcomes in the order of the plan.

    Raises:
        RunStopped: a stop was requested; also raises what `load_outcome` raises.
    """
    outcomes = [load_outcome(planned, out) for planned in plan.runs]
    for index, outcome in enumerate(outcomes):
        planned = outcome.run
        title = f"run {index + 1} of {len(outcomes)}, {planned.name}"
        if outcome.state is RunState.FINISHED:
            display.info(f"{title}: already finished")
            continue
        is_interrupted = outcome.state is RunState.INTERRUPTED
        display.info(f"{title}: {'resuming' if is_interrupted else 'starting'}")
        outcomes[index] = _execute_run(planned, out / planned.name, trainer, display, stop)
        after_each(outcomes)
    return outcomes


def _execute_run(
    planned: PlannedRun, folder: Path, trainer: RunFunctions, display: Display, stop: StopRequest
) -> RunOutcome:
    (folder / FAILED_FILE).unlink(missing_ok=True)
    try:
        if (folder / CHECKPOINTS_FOLDER / LAST_CHECKPOINT).is_file():
            report = trainer.resume(folder, {}, display, stop)
        else:
            _remove_unstarted(folder)
            reserved = {"default_root_dir": str(folder.parent), "run_name": folder.name}
            report = trainer.begin(build_arguments(planned.arguments, reserved), display, stop)
    except RunStopped:
        raise
    # Any error, such as running out of memory, must not stop the remaining runs.
    except Exception as error:
        reason = {
            "code": error.code if isinstance(error, PlacewiseError) else type(error).__name__,
            "detail": str(error),
        }
        folder.mkdir(parents=True, exist_ok=True)
        trace = traceback.format_exception(error)
        (folder / FAILED_FILE).write_text(json.dumps({**reason, "trace": trace}, indent=1) + "\n")
        display.warn(f"{planned.name} failed: {reason['code']}: {reason['detail']}")
        return RunOutcome(planned, RunState.FAILED, error=reason)
    return RunOutcome(planned, RunState.FINISHED, report=report)


def _remove_unstarted(folder: Path) -> None:
    """Remove the folder of a run that never completed a step."""
    if (folder / CONFIG_FILE).is_file():
        shutil.rmtree(folder)


def _check_same_arguments(planned: PlannedRun, folder: Path) -> None:
    stored = to_plain_dict(build_arguments(load_yaml(folder / CONFIG_FILE)))
    expected = to_plain_dict(build_arguments(planned.arguments))
    # Paths and cities are resolved when a run starts, so their stored values may differ.
    differing = [
        name
        for name in planned.arguments
        if name not in ("data_root", "eval_roots", "cities") and stored[name] != expected[name]
    ]
    if differing:
        raise Conflict(
            "grid_run_differs",
            f"The run in {folder} has a different {', '.join(differing)} than the grid. Use "
            "another --out, rename the run, or remove that folder.",
        )
