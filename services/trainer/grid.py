"""Many runs, one after the other: what is finished stays, what was interrupted goes on."""

from __future__ import annotations

import json
import shutil
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from services.trainer.configuration import build_arguments, load_yaml, to_plain_dict
from services.trainer.display import Display
from services.trainer.grid_plan import GridPlan, PlannedRun
from services.trainer.keep import LAST_CHECKPOINT
from services.trainer.run_folder import CHECKPOINTS_FOLDER, CONFIG_FILE, METRICS_FILE
from services.trainer.stop import RunStopped, StopRequest
from shared.errors import Conflict, PlacewiseError

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
