"""`placewise grid`: many training runs from one file, and their leaderboard."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from services.cli.output import JsonOption, answers, explained, messages, print_json
from services.cli.train import NEEDED, STOPPED
from services.cli.train_display import TerminalDisplay
from services.cli.train_options import chosen, with_training_options
from services.cli.trainer_packages import check_trainer_packages
from services.trainer.configuration import known_keys


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
    with explained(as_json):
        check_trainer_packages(*NEEDED)
        overrides = known_keys(chosen(arguments), "the command line")
        failed = _grid(file, out, dry_run, as_json, overrides)
    if failed:
        raise typer.Exit(1)


def _grid(file: Path, out: Path, dry_run: bool, as_json: bool, overrides: dict[str, Any]) -> int:
    from services.trainer import run
    from services.trainer.grid import Outcome, State, Trainer, outcome_of, run_grid
    from services.trainer.grid_plan import read_plan
    from services.trainer.leaderboard import leaderboard, write_leaderboard
    from services.trainer.stop import RunStopped, StopRequest

    plan = read_plan(file, overrides)
    if dry_run:
        there = [outcome_of(planned, out) for planned in plan.runs]
        _show([{"run": o.run.name, "state": str(o.state), **_texts(o.run.arguments)}
               for o in there], as_json)  # fmt: skip
        return 0

    def write(outcomes: list[Outcome]) -> None:
        out.mkdir(parents=True, exist_ok=True)
        write_leaderboard(leaderboard(plan, outcomes), out)

    with TerminalDisplay() as display, StopRequest().listening() as stop:
        try:
            trainer = Trainer(run.run, run.resume)
            outcomes = run_grid(plan, out, trainer, display, stop, write)
        except RunStopped as stopped:
            messages.print("Stopped. The same command goes on where the grid is.", soft_wrap=True)
            raise typer.Exit(STOPPED) from stopped
    write(outcomes)
    if as_json:
        print_json([asdict(outcome) for outcome in outcomes])
    else:
        _show(leaderboard(plan, outcomes), False)
        answers.print(f"Written: {out}/leaderboard.csv and {out}/leaderboard.md", markup=False)
    return sum(outcome.state is not State.FINISHED for outcome in outcomes)


def _texts(arguments: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in arguments.items()}


def _show(rows: list[dict[str, str]], as_json: bool) -> None:
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
    answers.print(table)
