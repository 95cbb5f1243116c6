"""`placewise train`: learn a place descriptor of one's own.

`placewise grid`: many training runs from one file, and their leaderboard.

A training run on the terminal: bars while it works, tables when it is done.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self

import typer
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table

from services.cli.environment import require_packages
from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from services.cli.training.options import given_options, with_training_options
from services.trainer.arguments import build_arguments, load_yaml, resolve_keys
from shared.errors import InvalidRequest

Json = dict[str, Any]

LOG_INTERVAL_SECONDS = 60.0
"""where stderr is no terminal, and bars would not be seen"""
SHOWN_KS = ("1", "5", "10", "20")


class TerminalDisplay:
    """Implements `services.trainer.run_control.Display` on stderr."""

    def __init__(self) -> None:
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=err_console,
            transient=True,
        )
        self._tasks: dict[str, TaskID] = {}
        self._line_at = time.monotonic() + LOG_INTERVAL_SECONDS

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bars.stop()

    def info(self, text: str) -> None:
        err_console.print(escape(text), soft_wrap=True)

    def warn(self, text: str) -> None:
        err_console.print(f"[yellow]{escape(text)}[/yellow]", soft_wrap=True)

    def progress(self, what: str, done: int, most: int, note: str = "") -> None:
        if not err_console.is_terminal:
            self._log_line(what, done, most, note)
            return
        task = self._tasks.get(what)
        if task is None:
            task = self._tasks[what] = self._bars.add_task(escape(what), total=most, note="")
        self._bars.update(task, completed=done, total=most, note=escape(note))
        if done >= most:
            self._bars.remove_task(self._tasks.pop(what))

    def _log_line(self, what: str, done: int, most: int, note: str) -> None:
        if time.monotonic() >= self._line_at:
            self._line_at = time.monotonic() + LOG_INTERVAL_SECONDS
            self.info(f"{what}: {done}/{most}  {note}".rstrip())


def print_summary(report: Json) -> None:
    """A run's summary: sets x R@k, the best checkpoint, what to type next."""
    if report.get("fast_dev_run"):
        return
    rows = _summary_rows(report)
    if rows:
        columns = (Column(f"R@{k}", justify="right") for k in SHOWN_KS)
        table = Table("set", "of", *columns, "queries", "fingerprint")
        for name, what, recall in rows:
            about = report["sets"][name]
            table.add_row(
                escape(name),
                what,
                *(f"{recall[k]:.1%}" if recall.get(k) is not None else "-" for k in SHOWN_KS),
                str(about["queries"]),
                f"{about['fingerprint'][:12]} {about['protocol']}, {about['rule']}",
            )
        console.print(table)
    best = report["best"]
    console.print(
        f"Checkpoint: {best['path']} ({best['dimension']} dimensions, {best['fingerprint'][:12]})",
        soft_wrap=True,
        markup=False,
    )
    if "images" in report and report["images_per_second"]:
        console.print(
            f"{report['images']} photos learned from, {report['images_per_second']:.1f}/s, "
            f"{report['share_waiting_for_data']:.1%} of the time waiting for photos; "
            f"{len(report['bad_photos'])} photos did not decode.",
            soft_wrap=True,
        )
    console.print("Next:", *(f"  {line}" for line in report["next"]), sep="\n", markup=False,
                  soft_wrap=True)  # fmt: skip


def _summary_rows(report: Json) -> list[tuple[str, str, Json]]:
    rows = []
    if report.get("epochs"):
        monitor = report["monitor"]
        chosen = max(
            report["epochs"],
            key=lambda each: (
                each["figures"].get(monitor, 0.0)
                * (1 if report["arguments"]["mode"] == "max" else -1)
            ),
        )
        for name in report["arguments"]["val_set_names"]:
            recall = {k: chosen["figures"].get(f"{name}/R{k}") for k in SHOWN_KS}
            rows.append((name, f"validation, epoch {chosen['number'] + 1}", recall))
    rows += [(name, "test", one["recall"]) for name, one in report["test"].items()]
    return rows


TRAINING_PACKAGES = ("lightning", "pytorch_metric_learning", "faiss", "torch", "yaml")
EXIT_INTERRUPTED = 130  # what a shell reports for a program that Ctrl-C ended


@with_training_options
def train(
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML file of arguments; options override it."),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", help="Go on with the run in this folder, exactly as it was."),
    ] = None,
    as_json: JsonOption = False,
    **arguments: Any,
) -> None:
    """Train a place descriptor, validate it while it learns, and test the best checkpoint.

    Lists and dicts are JSON. A true-or-false option stands alone, as --no-NAME, or before True or
    False. Names may be written with hyphens. Ctrl-C keeps the run: --resume goes on with it.
    """
    with report_errors(as_json):
        require_packages(*TRAINING_PACKAGES)
        report = _run_training(
            config, resume, resolve_keys(given_options(arguments), "the command line")
        )
    if as_json:
        print_json(report)
    else:
        print_summary(report)


def _run_training(config: Path | None, resume: Path | None, overrides: dict[str, Any]) -> Any:
    from services.trainer import run
    from services.trainer.run_control import RunStopped, StopRequest

    if config is not None and resume is not None:
        raise InvalidRequest(
            "bad_argument", "--resume has the run's own arguments: leave --config out."
        )
    with TerminalDisplay() as display, StopRequest().handle_signals() as stop:
        try:
            if resume is not None:
                return run.resume(resume, overrides, display, stop)
            layers = [load_yaml(config)] if config is not None else []
            return run.run(build_arguments(*layers, overrides), display, stop)
        except RunStopped as stopped:
            err_console.print(str(stopped), markup=False, soft_wrap=True)
            raise typer.Exit(EXIT_INTERRUPTED) from stopped


@with_training_options
def grid(
    file: Annotated[Path, typer.Argument(help="YAML file: base, grid, runs.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the runs.")] = Path("LOGS/grid"),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check every run and list them; train nothing.")
    ] = False,
    as_json: JsonOption = False,
    **arguments: Any,
) -> None:
    """Train every run of a file: aggregators x losses x miners, or any other arguments.

    Runs that are finished stay as they are, an interrupted one goes on, one that fails is named
    and the others are made. Options of `placewise train` override every run's.
    """
    with report_errors(as_json):
        require_packages(*TRAINING_PACKAGES)
        overrides = resolve_keys(given_options(arguments), "the command line")
        failed = _run_grid_command(file, out, dry_run, as_json, overrides)
    if failed:
        raise typer.Exit(1)


def _run_grid_command(
    file: Path, out: Path, dry_run: bool, as_json: bool, overrides: dict[str, Any]
) -> int:
    from services.trainer import run
    from services.trainer.grid import (
        RunFunctions,
        RunOutcome,
        RunState,
        load_grid_plan,
        load_outcome,
        run_grid,
    )
    from services.trainer.leaderboard import leaderboard, write_leaderboard
    from services.trainer.run_control import RunStopped, StopRequest

    plan = load_grid_plan(file, overrides)
    if dry_run:
        there = [load_outcome(planned, out) for planned in plan.runs]
        _print_rows([{"run": o.run.name, "state": str(o.state), **_to_strings(o.run.arguments)}
               for o in there], as_json)  # fmt: skip
        return 0

    def write(outcomes: list[RunOutcome]) -> None:
        out.mkdir(parents=True, exist_ok=True)
        write_leaderboard(leaderboard(plan, outcomes), out)

    with TerminalDisplay() as display, StopRequest().handle_signals() as stop:
        try:
            trainer = RunFunctions(run.run, run.resume)
            outcomes = run_grid(plan, out, trainer, display, stop, write)
        except RunStopped as stopped:
            err_console.print(
                "Stopped. The same command goes on where the grid is.", soft_wrap=True
            )
            raise typer.Exit(EXIT_INTERRUPTED) from stopped
    write(outcomes)
    if as_json:
        print_json([asdict(outcome) for outcome in outcomes])
    else:
        _print_rows(leaderboard(plan, outcomes), False)
        console.print(f"Written: {out}/leaderboard.csv and {out}/leaderboard.md", markup=False)
    return sum(outcome.state is not RunState.FINISHED for outcome in outcomes)


def _to_strings(arguments: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in arguments.items()}


def _print_rows(rows: list[dict[str, str]], as_json: bool) -> None:
    if as_json:
        print_json(rows)
        return
    columns = list(dict.fromkeys(column for row in rows for column in row))
    # What all runs share is no news.
    if len(rows) > 1:
        columns = [c for c in columns if len({row.get(c, "") for row in rows}) > 1 or c == "run"]
    table = Table(*columns)
    for row in rows:
        table.add_row(*(row.get(column, "") for column in columns))
    console.print(table)
