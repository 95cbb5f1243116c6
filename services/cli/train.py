"""`placewise train`: learn a place descriptor of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from services.cli.output import JsonOption, err_console, print_json, report_errors
from services.cli.train_display import TerminalDisplay, print_summary
from services.cli.train_options import given_options, with_training_options
from services.cli.trainer_packages import require_packages
from services.trainer.configuration import build_arguments, load_yaml, resolve_keys
from shared.errors import InvalidRequest

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
    from services.trainer.stop import RunStopped, StopRequest

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
