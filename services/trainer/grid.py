"""Many runs, one after the other: what is finished stays, what was interrupted goes on.

The runs of a grid, as its YAML file says them.

    base: {lr: 0.0002}                   # arguments of every run
    grid:                                # every combination
      agg_arch: [AVG, GeM]
      loss: [{loss_name: NTXentLoss}, {loss_name: FastAPLoss, miner_name: AngularMiner}]
    runs:                                # or one by one
      - {name: baseline, agg_arch: GeM, published: {sfxs_val/R1: 63.59}}
    fingerprints: {sfxs_val: 0123...}    # of the sets that the published figures were made on

A value of an axis that is a mapping sets several arguments; then the axis's own name is only a
label.
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
from services.trainer.module import build_model_config
from services.trainer.run_control import Display, RunStopped, StopRequest
from services.trainer.run_folder import CHECKPOINTS_FOLDER, CONFIG_FILE, METRICS_FILE
from shared.errors import Conflict, InvalidRequest, PlacewiseError

GRID_KEYS = ("base", "grid", "runs", "fingerprints")
RESERVED_ARGUMENTS = ("default_root_dir", "run_name")
"""which the grid gives to each run itself"""


@dataclass(frozen=True, slots=True)
class PlannedRun:
    name: str
    arguments: dict[str, Any]
    published: dict[str, float] = field(default_factory=dict)
    """SET/R1 -> per cent, of somebody else's run with these settings"""


@dataclass(frozen=True, slots=True)
class GridPlan:
    runs: tuple[PlannedRun, ...]
    fingerprints: dict[str, str]
    """of the sets on which the published figures were made; empty: not known"""


def load_grid_plan(path: Path, overrides: Mapping[str, Any]) -> GridPlan:
    """The plan in a YAML file, with arguments that override every run's.

    Every run's arguments and names are checked before the first begins. Raises NotFound
    (`config_not_found`), InvalidRequest (`bad_grid`, `unknown_argument`, `bad_argument`), and what
    an unknown backbone, aggregator, loss or miner is.
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
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise _grid_error(
            path, f"several runs are called {', '.join(twice)}: give each a name of its own"
        )
    fingerprints = _require_mapping(path, "fingerprints", stored.get("fingerprints"))
    return GridPlan(tuple(runs), {name: str(value) for name, value in fingerprints.items()})


def _expand_grid(path: Path, axes: dict[str, Any]) -> list[tuple[str, dict[str, Any], Any]]:
    options: list[list[tuple[str, dict[str, Any]]]] = []
    for axis, values in axes.items():
        if not isinstance(values, list) or not values:
            raise _grid_error(path, f"grid, {axis}: a list of values is needed")
        options.append([_axis_option(path, axis, value) for value in values])
    found: list[tuple[str, dict[str, Any], Any]] = []
    for chosen in itertools.product(*options) if options else ():
        arguments: dict[str, Any] = {}
        for _, values in chosen:
            arguments |= values
        found.append(("-".join(label for label, _ in chosen), arguments, {}))
    return found


def _axis_option(path: Path, axis: str, value: Any) -> tuple[str, dict[str, Any]]:
    if isinstance(value, dict):
        arguments = resolve_keys(value, f"{path}, grid, {axis}")
        label = "-".join(
            str(each) for each in arguments.values() if not isinstance(each, (dict, list))
        )
        return label or axis, arguments
    return str(value), {resolve_name(axis): value}


def _listed_runs(path: Path, runs: Any) -> list[tuple[str, dict[str, Any], Any]]:
    found = []
    for number, entry in enumerate(runs if isinstance(runs, list) else [runs], start=1):
        values = dict(_require_mapping(path, f"runs, {number}", entry))
        name = str(values.pop("name", f"{number:02d}"))
        published = _require_mapping(path, f"{name}, published", values.pop("published", None))
        found.append((name, resolve_keys(values, f"{path}, runs, {name}"), published))
    return found


def _plan_run(path: Path, name: str, values: dict[str, Any], published: Any) -> PlannedRun:
    given = [key for key in RESERVED_ARGUMENTS if key in values]
    if given:
        raise _grid_error(
            path, f"{', '.join(given)} can't be given: each run has its folder in --out"
        )
    try:
        arguments = build_arguments(values)
        build_model_config(arguments)
        make_loss(arguments.loss_name)
        make_miner(arguments.miner_name, arguments.miner_margin)
        figures = {str(key): float(value) for key, value in published.items()}
    except PlacewiseError as error:
        raise type(error)(error.code, f"{path}, {name}: {error.detail}") from error
    except (TypeError, ValueError) as error:
        raise _grid_error(path, f"{name}, published: numbers are needed") from error
    return PlannedRun(safe_filename(name), values, figures)


def _require_mapping(path: Path, location: str, value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise _grid_error(path, f"{location}: names with values are needed")
    return value


def _grid_error(path: Path, detail: str) -> InvalidRequest:
    return InvalidRequest("bad_grid", f"{path}: {detail}.")


FAILED_FILE = "failed.json"

Json = dict[str, Any]


class RunState(StrEnum):
    FINISHED = "finished"
    """its summary is there"""
    INTERRUPTED = "interrupted"
    """it has a last.ckpt to go on from"""
    FAILED = "failed"
    """it ended with an error; it is tried again"""
    WAITING = "waiting"
    """it has not made a step"""


@dataclass(frozen=True, slots=True)
class RunOutcome:
    run: PlannedRun
    state: RunState
    report: Json | None = None
    """`metrics.json` of a finished run"""
    error: Json | None = None
    """`code` and `detail` of a failed one"""


@dataclass(frozen=True, slots=True)
class RunFunctions:
    """How one run is made; `services.trainer.run` has both."""

    begin: Callable[..., Json]
    resume: Callable[..., Json]


def load_outcome(planned: PlannedRun, out: Path) -> RunOutcome:
    """How far the run of this plan is in its folder below `out`.

    Raises Conflict (`grid_run_differs`) for one that was made with other arguments.
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
    """Make every run that is not finished; one that fails is named and the others go on.

    `after_each` is told all outcomes so far. Raises RunStopped when the end was asked for, and what
    `load_outcome` raises.
    """
    outcomes = [load_outcome(planned, out) for planned in plan.runs]
    for number, before in enumerate(outcomes):
        planned = before.run
        title = f"run {number + 1} of {len(outcomes)}, {planned.name}"
        if before.state is RunState.FINISHED:
            display.info(f"{title}: finished before")
            continue
        display.info(f"{title}: {'goes on' if before.state is RunState.INTERRUPTED else 'begins'}")
        outcomes[number] = _run_one(before, out / planned.name, trainer, display, stop)
        after_each(outcomes)
    return outcomes


def _run_one(
    before: RunOutcome, folder: Path, trainer: RunFunctions, display: Display, stop: StopRequest
) -> RunOutcome:
    planned = before.run
    (folder / FAILED_FILE).unlink(missing_ok=True)
    try:
        if (folder / CHECKPOINTS_FOLDER / LAST_CHECKPOINT).is_file():
            report = trainer.resume(folder, {}, display, stop)
        else:
            _remove_unstarted(folder)
            own = {"default_root_dir": str(folder.parent), "run_name": folder.name}
            report = trainer.begin(build_arguments(planned.arguments, own), display, stop)
    except RunStopped:
        raise
    # A run that needs too much memory, say, must not take the night's others with it.
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
    """Remove what a run left that never made a step."""
    if (folder / CONFIG_FILE).is_file():
        shutil.rmtree(folder)


def _check_same_arguments(planned: PlannedRun, folder: Path) -> None:
    made = to_plain_dict(build_arguments(load_yaml(folder / CONFIG_FILE)))
    wanted = to_plain_dict(build_arguments(planned.arguments))
    # Names of sets and paths are resolved when a run begins: they need not read alike.
    differing = [
        name
        for name in planned.arguments
        if name not in ("data_root", "eval_roots", "cities") and made[name] != wanted[name]
    ]
    if differing:
        raise Conflict(
            "grid_run_differs",
            f"{folder} was made with another {', '.join(differing)} than the grid says now. Give "
            "another --out, rename the run, or remove that folder.",
        )
