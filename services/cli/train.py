"""`placewise train`: learn a place descriptor of one's own."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated, Any

import typer

from services.cli.output import JsonOption, explained, messages, print_json
from services.cli.train_display import TerminalDisplay, show_report
from services.cli.train_options import chosen, with_training_options
from services.trainer.configuration import known_keys, make_arguments, read_yaml
from shared.errors import InvalidRequest, Misconfigured

NEEDED = ("lightning", "pytorch_metric_learning", "faiss", "torch", "yaml")
STOPPED = 130  # what a shell reports for a program that Ctrl-C ended


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
    with explained(as_json):
        need_trainer()
        report = _train(config, resume, known_keys(chosen(arguments), "the command line"))
    if as_json:
        print_json(report)
    else:
        show_report(report)


def need_trainer() -> None:
    """Misconfigured (`trainer_missing`) where what training needs is not installed."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise Misconfigured(
            "trainer_missing",
            f"Training needs {', '.join(missing)}: install placewise[trainer].",
        )


def _train(config: Path | None, resume: Path | None, said: dict[str, Any]) -> Any:
    from services.trainer import run
    from services.trainer.stop import RunStopped, StopRequest

    if config is not None and resume is not None:
        raise InvalidRequest(
            "bad_argument", "--resume has the run's own arguments: leave --config out."
        )
    with TerminalDisplay() as display, StopRequest().listening() as stop:
        try:
            if resume is not None:
                return run.resume(resume, said, display, stop)
            layers = [read_yaml(config)] if config is not None else []
            return run.run(make_arguments(*layers, said), display, stop)
        except RunStopped as stopped:
            messages.print(str(stopped), markup=False, soft_wrap=True)
            raise typer.Exit(STOPPED) from stopped
