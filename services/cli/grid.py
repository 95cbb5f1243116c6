"""`placewise grid`: many training runs from one file, and their leaderboard."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from services.cli.train import EXIT_INTERRUPTED, TRAINING_PACKAGES
from services.cli.train_display import TerminalDisplay
from services.cli.train_options import given_options, with_training_options
from services.cli.trainer_packages import require_packages
from services.trainer.configuration import resolve_keys


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
    from services.trainer.grid import RunFunctions, RunOutcome, RunState, load_outcome, run_grid
    from services.trainer.grid_plan import load_grid_plan
    from services.trainer.leaderboard import leaderboard, write_leaderboard
    from services.trainer.stop import RunStopped, StopRequest

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
