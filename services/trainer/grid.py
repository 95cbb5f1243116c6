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

from services.trainer.configuration import as_plain, make_arguments, read_yaml
from services.trainer.display import Display
from services.trainer.grid_plan import GridPlan, PlannedRun
from services.trainer.keep import LAST
from services.trainer.run_folder import CHECKPOINTS, CONFIG, METRICS
from services.trainer.stop import RunStopped, StopRequest
from shared.errors import Conflict, PlacewiseError

FAILED = "failed.json"

Json = dict[str, Any]


class State(StrEnum):
    FINISHED = "finished"
    """its summary is there"""
    INTERRUPTED = "interrupted"
    """it has a last.ckpt to go on from"""
    FAILED = "failed"
    """it ended with an error; it is tried again"""
    WAITING = "waiting"
    """it has not made a step"""


@dataclass(frozen=True, slots=True)
class Outcome:
    run: PlannedRun
    state: State
    report: Json | None = None
    """`metrics.json` of a finished run"""
    error: Json | None = None
    """`code` and `detail` of a failed one"""


@dataclass(frozen=True, slots=True)
class Trainer:
    """How one run is made; `services.trainer.run` has both."""

    begin: Callable[..., Json]
    resume: Callable[..., Json]


def outcome_of(planned: PlannedRun, out: Path) -> Outcome:
    """How far the run of this plan is in its folder below `out`.

    Raises Conflict (`grid_run_differs`) for one that was made with other arguments.
    """
    folder = out / planned.name
    if (folder / CONFIG).is_file():
        _check_same(planned, folder)
    if (folder / METRICS).is_file():
        report = json.loads((folder / METRICS).read_text())
        return Outcome(planned, State.FINISHED, report=report)
    if (folder / FAILED).is_file():
        return Outcome(planned, State.FAILED, error=json.loads((folder / FAILED).read_text()))
    if (folder / CHECKPOINTS / LAST).is_file():
        return Outcome(planned, State.INTERRUPTED)
    return Outcome(planned, State.WAITING)


def run_grid(
    plan: GridPlan,
    out: Path,
    trainer: Trainer,
    display: Display,
    stop: StopRequest,
    after_each: Callable[[list[Outcome]], None],
) -> list[Outcome]:
    """Make every run that is not finished; one that fails is named and the others go on.

    `after_each` is told all outcomes so far. Raises RunStopped when the end was asked for, and what
    `outcome_of` raises.
    """
    outcomes = [outcome_of(planned, out) for planned in plan.runs]
    for number, before in enumerate(outcomes):
        planned = before.run
        title = f"run {number + 1} of {len(outcomes)}, {planned.name}"
        if before.state is State.FINISHED:
            display.say(f"{title}: finished before")
            continue
        display.say(f"{title}: {'goes on' if before.state is State.INTERRUPTED else 'begins'}")
        outcomes[number] = _make(before, out / planned.name, trainer, display, stop)
        after_each(outcomes)
    return outcomes


def _make(
    before: Outcome, folder: Path, trainer: Trainer, display: Display, stop: StopRequest
) -> Outcome:
    planned = before.run
    (folder / FAILED).unlink(missing_ok=True)
    try:
        if (folder / CHECKPOINTS / LAST).is_file():
            report = trainer.resume(folder, {}, display, stop)
        else:
            _clear(folder)
            own = {"default_root_dir": str(folder.parent), "run_name": folder.name}
            report = trainer.begin(make_arguments(planned.arguments, own), display, stop)
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
        (folder / FAILED).write_text(json.dumps({**reason, "trace": trace}, indent=1) + "\n")
        display.warn(f"{planned.name} failed: {reason['code']}: {reason['detail']}")
        return Outcome(planned, State.FAILED, error=reason)
    return Outcome(planned, State.FINISHED, report=report)


def _clear(folder: Path) -> None:
    """Remove what a run left that never made a step."""
    if (folder / CONFIG).is_file():
        shutil.rmtree(folder)


def _check_same(planned: PlannedRun, folder: Path) -> None:
    made = as_plain(make_arguments(read_yaml(folder / CONFIG)))
    wanted = as_plain(make_arguments(planned.arguments))
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
