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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lab.training import run
from lab.training.arguments import (
    build_arguments,
    load_mapping,
    load_yaml,
    resolve_keys,
    suggest_name,
    to_plain_dict,
)
from lab.training.checkpointing import LAST_CHECKPOINT, safe_filename
from lab.training.losses import make_loss, make_miner
from lab.training.model_factory import build_model_config
from lab.training.run_control import Display, RunStopped, StopRequest
from lab.training.run_folder import CHECKPOINTS_FOLDER, CONFIG_FILE, METRICS_FILE, lock_folder
from shared.errors import Conflict, InvalidRequest, PlacewiseError

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


class _ListedRun(BaseModel):
    """A run of `runs`; its other keys are arguments."""

    model_config = ConfigDict(extra="allow", coerce_numbers_to_str=True)

    name: str | None = None
    published: dict[str, float] | None = None


class _GridFile(BaseModel):
    """The keys of a grid's YAML file."""

    model_config = ConfigDict(extra="forbid", coerce_numbers_to_str=True)

    base: dict[str, Any] | None = None
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] | None = None
    runs: list[_ListedRun] | None = None
    fingerprints: dict[str, str] | None = None


def load_grid_plan(path: Path, overrides: Mapping[str, Any]) -> GridPlan:
    """Load a grid from a YAML file and validate the arguments of all runs, after `overrides`.

    Raises NotFound (`config_not_found`), InvalidRequest (`bad_grid`, `unknown_argument`,
    `bad_argument`), and the errors of an unknown backbone, aggregator, loss or miner.
    """
    try:
        stored = _GridFile.model_validate(load_mapping(path))
    except ValidationError as error:
        raise _grid_error(path, _describe_first(error)) from error
    base = resolve_keys(stored.base or {}, f"{path}, base")
    runs = [
        _plan_run(path, name, {**base, **arguments, **overrides}, published)
        for name, arguments, published in (
            *_expand_grid(path, stored.grid or {}),
            *_listed_runs(path, stored.runs or []),
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
    return GridPlan(tuple(runs), stored.fingerprints or {})


RunSettings = tuple[str, dict[str, Any], dict[str, float]]
"""Name, arguments and published results"""


def _expand_grid(path: Path, axes: Mapping[str, list[Any]]) -> Iterator[RunSettings]:
    options = [[_axis_option(path, axis, value) for value in axes[axis]] for axis in axes]
    for combination in itertools.product(*options) if options else ():
        arguments: dict[str, Any] = {}
        for _, values in combination:
            arguments |= values
        yield "-".join(label for label, _ in combination), arguments, {}


def _axis_option(path: Path, axis: str, value: Any) -> tuple[str, dict[str, Any]]:
    if isinstance(value, dict):
        arguments = resolve_keys(value, f"{path}, grid, {axis}")
        label = "-".join(
            str(each) for each in arguments.values() if not isinstance(each, (dict, list))
        )
        return label or axis, arguments
    return str(value), resolve_keys({axis: value}, f"{path}, grid")


def _listed_runs(path: Path, runs: Sequence[_ListedRun]) -> Iterator[RunSettings]:
    for number, listed in enumerate(runs, start=1):
        name = listed.name or f"{number:02d}"
        arguments = resolve_keys(listed.model_extra or {}, f"{path}, runs, {name}")
        yield name, arguments, listed.published or {}


def _plan_run(
    path: Path, name: str, values: dict[str, Any], published: dict[str, float]
) -> PlannedRun:
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
    except PlacewiseError as error:
        raise type(error)(error.code, f"{path}, {name}: {error.detail}") from error
    return PlannedRun(safe_filename(name), values, published)


def _describe_first(error: ValidationError) -> str:
    first = error.errors()[0]
    location = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"there is no key {location!r}.{suggest_name(location, _GridFile.model_fields)}"
    return f"{location}: {first['msg']} (got {first['input']!r})"


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


def load_outcome(planned: PlannedRun, out: Path) -> RunOutcome:
    """Determine the state of a planned run from its folder below `out`.

    Raises Conflict: `grid_run_differs`, if the folder's run has other arguments.
    """
    folder = out / planned.name
    if (folder / CONFIG_FILE).is_file():
        _check_same_arguments(planned, folder)
    if (folder / METRICS_FILE).is_file():
        report = json.loads((folder / METRICS_FILE).read_text())
        return RunOutcome(planned, RunState.FINISHED, report=report)
    if (folder / FAILED_FILE).is_file():
        error = json.loads((folder / FAILED_FILE).read_text())
        return RunOutcome(planned, RunState.FAILED, error=error)
    if (folder / CHECKPOINTS_FOLDER / LAST_CHECKPOINT).is_file():
        return RunOutcome(planned, RunState.INTERRUPTED)
    return RunOutcome(planned, RunState.WAITING)


def run_grid(
    plan: GridPlan,
    out: Path,
    display: Display,
    stop: StopRequest,
    after_each: Callable[[list[RunOutcome]], None],
) -> list[RunOutcome]:
    """Execute all unfinished runs below `out` one after the other; a failed run does not stop them.

    `after_each` is called with all outcomes, in the order of the plan, after each run.

    Raises RunStopped if a stop was requested, Conflict (`run_in_use`) while another process
    executes the grid, and what `load_outcome` raises.
    """
    out.mkdir(parents=True, exist_ok=True)
    with lock_folder(out):
        outcomes = [load_outcome(planned, out) for planned in plan.runs]
        reported: dict[str, str] = {}  # reason -> the first run that failed for it
        for index, outcome in enumerate(outcomes):
            stop.check()
            planned = outcome.run
            title = f"run {index + 1} of {len(outcomes)}, {planned.name}"
            if outcome.state is RunState.FINISHED:
                display.info(f"{title}: already finished")
                continue
            is_interrupted = outcome.state is RunState.INTERRUPTED
            display.info(f"{title}: {'resuming' if is_interrupted else 'starting'}")
            outcomes[index] = _execute_run(planned, out / planned.name, display, stop)
            error = outcomes[index].error
            if error is not None:
                first = reported.setdefault(error["detail"], planned.name)
                reason = error["detail"] if first == planned.name else f"as {first}"
                display.warn(f"{planned.name} failed: {error['code']}: {reason}")
            after_each(outcomes)
        return outcomes


# Settings that decide neither the data nor the network.
_HARMLESS_ARGUMENTS = {"loss_name", "miner_name", "miner_margin", "lr", "max_epochs", "seed"}


def find_grid_obstacles(plan: GridPlan) -> dict[str, list[str]]:
    """Return the names of the runs that can't start on this machine, by error ("code: detail").

    Runs that differ only in their training settings are checked once.
    """
    checked: dict[str, list[PlacewiseError]] = {}
    blocked: dict[str, list[str]] = {}
    for planned in plan.runs:
        arguments = build_arguments(planned.arguments)
        key = arguments.model_dump_json(exclude=_HARMLESS_ARGUMENTS)
        if key not in checked:
            checked[key] = run.find_obstacles(arguments)
        for error in checked[key]:
            blocked.setdefault(f"{error.code}: {error.detail}", []).append(planned.name)
    return blocked


def _execute_run(
    planned: PlannedRun, folder: Path, display: Display, stop: StopRequest
) -> RunOutcome:
    (folder / FAILED_FILE).unlink(missing_ok=True)
    try:
        if (folder / CHECKPOINTS_FOLDER / LAST_CHECKPOINT).is_file():
            report = run.resume(folder, {}, display, stop)
        else:
            if (folder / CONFIG_FILE).is_file():  # it never completed a step
                shutil.rmtree(folder)
            reserved = {"default_root_dir": str(folder.parent), "run_name": folder.name}
            report = run.run(build_arguments(planned.arguments, reserved), display, stop)
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
        return RunOutcome(planned, RunState.FAILED, error=reason)
    return RunOutcome(planned, RunState.FINISHED, report=report)


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
