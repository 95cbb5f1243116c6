"""The command's tree, of which a run imports only the branch that it is asked for."""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Collection

import typer

# In the order of the help: the module below services.cli, and what of it is the command.
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
    """The commands of these names. Each brings libraries that the others can do without."""
    app = typer.Typer(
        name="placewise",
        help="Photo in, place out: visual place recognition on your own photos.",
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
    """Parse the command line and do it."""
    logging.basicConfig(
        level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    asked = sys.argv[1:2]
    # What is no command is answered by the whole tree: the help, or what was meant.
    build_app(asked if asked and asked[0] in COMMANDS else COMMANDS.keys())()


def _root_callback() -> None:
    """Makes a tree of one command a tree, too."""
