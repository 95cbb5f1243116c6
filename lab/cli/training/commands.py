"""`placewise train` and `placewise grid`: train place descriptors, and run hyperparameter grids."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.progress import Progress, TaskID
from rich.table import Column

from lab.cli.training.options import given_options, with_training_options
from lab.training.arguments import build_arguments, load_yaml
from services.cli.environment import require_packages
from services.cli.output import (
    Json,
    JsonOption,
    Table,
    console,
    err_console,
    format_percent,
    print_json,
    print_message,
    print_note,
    print_table,
    progress_bar,
)
from shared.errors import InvalidRequest

SHOWN_KS = ("1", "5", "10", "15", "20")


@dataclass(slots=True)
class _TerminalDisplay:
    """Implements `lab.training.run_control.Display` with progress bars on stderr."""

    bars: Progress
    tasks: dict[str, TaskID] = field(default_factory=dict)

    def info(self, text: str) -> None:
        print_note(text)

    def warn(self, text: str) -> None:
        err_console.print(f"[yellow]{escape(text)}[/yellow]", soft_wrap=True)

    def progress(self, what: str, done: int, total: int, note: str = "") -> None:
        if what not in self.tasks:
            self.tasks[what] = self.bars.add_task(escape(what), total=total)
        description = escape(f"{what}  {note}".rstrip())
        self.bars.update(self.tasks[what], completed=done, total=total, description=description)
        if done >= total:
            self.bars.remove_task(self.tasks.pop(what))


def _print_summary(report: Json) -> None:
    """Print a run's summary: R@k per set, the best checkpoint and suggested next commands."""
    if report.get("fast_dev_run"):
        return
    rows = _summary_rows(report)
    if rows:
        columns = (Column(f"R@{k}", justify="right") for k in SHOWN_KS)
        table = Table("set", "stage", *columns, "queries", "fingerprint")
        for name, stage, recall in rows:
            set_info = report["sets"][name]
            table.add_row(
                escape(name),
                stage,
                *(format_percent(recall.get(k)) for k in SHOWN_KS),
                str(set_info["queries"]),
                f"{set_info['fingerprint'][:12]} {set_info['protocol']}, {set_info['rule']}",
            )
        print_table(table)
    best = report["best"]
    print_message(
        f"Checkpoint: {best['path']} ({best['dimension']} dimensions, {best['fingerprint'][:12]})"
    )
    if "images" in report and report["images_per_second"]:
        print_message(
            f"Trained on {report['images']} photos ({report['images_per_second']:.1f}/s; "
            f"{format_percent(report['share_waiting_for_data'])} of the time waiting for data). "
            f"{len(report['bad_photos'])} photos could not be decoded."
        )
    console.print("Next:", *(f"  {line}" for line in report["next"]), sep="\n", markup=False,
                  soft_wrap=True)  # fmt: skip


def _summary_rows(report: Json) -> list[tuple[str, str, Json]]:
    from lab.training.leaderboard import best_epoch

    rows = []
    if report.get("epochs"):
        best = best_epoch(report)
        for name in report["arguments"]["val_set_names"]:
            recall = {k: best["figures"].get(f"{name}/R{k}") for k in SHOWN_KS}
            rows.append((name, f"validation, epoch {best['number'] + 1}", recall))
    rows += [(name, "test", result["recall"]) for name, result in report["test"].items()]
    return rows


TRAINING_PACKAGES = ("lightning", "pytorch_metric_learning", "faiss", "torch", "yaml")
EXIT_INTERRUPTED = 130  # the shell's exit status for a program ended by Ctrl-C


@with_training_options
def train(
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML file of arguments. Command-line options override it."),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", help="Resume the run in this folder with its own arguments."),
    ] = None,
    as_json: JsonOption = False,
    **arguments: Any,
) -> None:
    """Train a place descriptor, validate it during training, and test the best checkpoint.

    Lists and dicts are JSON. A boolean option is written as --NAME, --no-NAME, or --NAME True or
    False. Option names may contain hyphens or underscores. A run stopped with Ctrl-C can be
    continued with --resume.
    """
    require_packages(*TRAINING_PACKAGES)
    overrides = given_options(arguments)
    if config is not None and resume is not None:
        raise InvalidRequest(
            "bad_argument", "--resume uses the run's own arguments. Remove --config."
        )
    layers = [load_yaml(config)] if config is not None else []
    if resume is None:
        trained = build_arguments(*layers, overrides)

    # PyTorch and Lightning take half a minute to import from a cold disk.
    from lab.training import run
    from lab.training.run_control import RunStopped, StopRequest

    with progress_bar() as bars, StopRequest().handle_signals() as stop:
        display = _TerminalDisplay(bars)
        try:
            if resume is not None:
                report = run.resume(resume, overrides, display, stop)
            else:
                report = run.run(trained, display, stop)
        except RunStopped as stopped:
            print_note(str(stopped))
            raise typer.Exit(EXIT_INTERRUPTED) from stopped
    if as_json:
        print_json(report)
    else:
        _print_summary(report)


@with_training_options
def grid(
    file: Annotated[Path, typer.Argument(help="YAML file with base, grid and runs.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder of the runs.")] = Path(
        "LOGS/grid"
    ),
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="List all runs without training, and check device, data sets and weights. "
            "Missing weights are downloaded.",
        ),
    ] = False,
    as_json: JsonOption = False,
    **arguments: Any,
) -> None:
    """Train every run of a grid: aggregators x losses x miners, or any other arguments.

    Finished runs are skipped and interrupted runs are resumed. A failed run is reported, and the
    grid continues. Options of `placewise train` override those of every run.
    """
    require_packages(*TRAINING_PACKAGES)
    from lab.training.grid import (
        RunOutcome,
        RunState,
        find_grid_obstacles,
        load_grid_plan,
        load_outcome,
        run_grid,
    )
    from lab.training.leaderboard import leaderboard, write_leaderboard
    from lab.training.run_control import RunStopped, StopRequest

    plan = load_grid_plan(file, given_options(arguments))
    if dry_run:
        outcomes = [load_outcome(planned, out) for planned in plan.runs]
        rows = [
            {"run": o.run.name, "state": str(o.state)}
            | {name: str(value) for name, value in o.run.arguments.items()}
            for o in outcomes
        ]
        if as_json:
            print_json(rows)
        else:
            _print_rows(rows)
        obstacles = find_grid_obstacles(plan)
        for obstacle, blocked in obstacles.items():
            names = ", ".join(blocked) if len(blocked) < len(plan.runs) else "every run"
            print_note(f"{names} can't start: {obstacle}")
        if obstacles:
            raise typer.Exit(1)
        return

    def write(outcomes: list[RunOutcome]) -> None:
        out.mkdir(parents=True, exist_ok=True)
        write_leaderboard(leaderboard(plan, outcomes), out)

    with progress_bar() as bars, StopRequest().handle_signals() as stop:
        try:
            display = _TerminalDisplay(bars)
            outcomes = run_grid(plan, out, display, stop, write)
        except RunStopped as stopped:
            print_note("Stopped. Run the same command again to continue the grid.")
            raise typer.Exit(EXIT_INTERRUPTED) from stopped
    write(outcomes)
    if as_json:
        print_json([asdict(outcome) for outcome in outcomes])
    else:
        _print_rows(leaderboard(plan, outcomes))
        print_message(f"Wrote {out}/leaderboard.csv and {out}/leaderboard.md")
    if any(outcome.state is not RunState.FINISHED for outcome in outcomes):
        raise typer.Exit(1)


def _print_rows(rows: list[dict[str, str]]) -> None:
    columns = list(dict.fromkeys(column for row in rows for column in row))
    # Leave out columns whose value is the same for all runs.
    if len(rows) > 1:
        columns = [
            column
            for column in columns
            if column in ("run", "state") or len({row.get(column, "") for row in rows}) > 1
        ]
    table = Table(*columns)
    for row in rows:
        table.add_row(*(row.get(column, "") for column in columns))
    print_table(table)
