"""The Typer application of `placewise`, with lazily imported commands.

A run imports only the module of the command it executes: some commands load torch, which
takes seconds and is not installed in every image.
"""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Collection

import typer

# Command -> (module below services.cli, attribute). The order is that of the help.
COMMANDS = {
    "serve": ("operations.servers", "serve"),
    "search": ("operations.servers", "search"),
    "gateway": ("operations.servers", "gateway"),
    "extractor": ("operations.servers", "extractor"),
    "steward": ("operations.servers", "steward"),
    "migrate": ("operations.servers", "migrate"),
    "index": ("ingest.index", "index"),
    "import-anyloc": ("ingest.import_anyloc", "import_anyloc"),
    "query": ("query", "query"),
    "track": ("track.command", "track"),
    "export": ("export", "app"),
    "describe": ("descriptors.describe", "describe"),
    "evaluate": ("evaluation.commands", "evaluate"),
    "compare": ("evaluation.commands", "compare"),
    "config": ("environment", "config"),
    "doctor": ("operations.doctor", "doctor"),
    "keys": ("operations.keys", "app"),
    "maps": ("maps", "app"),
    "vocabulary": ("descriptors.vocabulary", "app"),
    "pca": ("descriptors.pca", "app"),
    "models": ("descriptors.models", "app"),
    "datasets": ("datasets.commands", "app"),
    "train": ("training.commands", "train"),
    "grid": ("training.commands", "grid"),
    "storage": ("operations.storage", "app"),
    "backup": ("operations.backup", "backup"),
    "restore": ("operations.backup", "restore"),
    "verify": ("operations.storage", "verify"),
    "rebuild-catalog": ("operations.backup", "rebuild_catalog"),
    "bench": ("bench", "app"),
}


def build_app(names: Collection[str] = COMMANDS.keys()) -> typer.Typer:
    """Build the application with the named commands, importing only their modules."""
    app = typer.Typer(
        name="placewise",
        help="Self-hosted visual place recognition: find where a photo was taken.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        add_completion=False,
    )
    app.callback()(_root_callback)
    for name in names:
        module, attribute = COMMANDS[name]
        command = getattr(importlib.import_module(f"services.cli.{module}"), attribute)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name, **getattr(command, "command_settings", {}))(command)
    return app


def run() -> None:
    """Parse the command line and run the command."""
    logging.basicConfig(
        level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    names = sys.argv[1:2]
    # Anything but a known command (--help, a typo) needs every command: for the help text and
    # for the suggestion of a similar name.
    build_app(names if names and names[0] in COMMANDS else COMMANDS.keys())()


def _root_callback() -> None:
    """Keep the application a command group even if it has only one command."""
