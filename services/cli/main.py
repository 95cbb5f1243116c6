"""The command's tree, of which a run imports only the branch that it is asked for."""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Collection

import typer

# In the order of the help: the module below services.cli, and what of it is the command.
COMMANDS = {
    "serve": ("serve", "serve"),
    "search": ("search", "search"),
    "gateway": ("processes", "gateway"),
    "extractor": ("processes", "extractor"),
    "steward": ("processes", "steward"),
    "migrate": ("processes", "migrate"),
    "index": ("index", "index"),
    "import-anyloc": ("import_anyloc", "import_anyloc"),
    "query": ("ask", "query"),
    "export": ("export", "app"),
    "describe": ("describe", "describe"),
    "evaluate": ("evaluate", "evaluate"),
    "compare": ("compare", "compare"),
    "config": ("configuration", "config"),
    "doctor": ("doctor", "doctor"),
    "keys": ("keys", "app"),
    "maps": ("maps", "app"),
    "vocabulary": ("vocabulary", "app"),
    "pca": ("pca", "app"),
    "models": ("models", "app"),
    "datasets": ("datasets.commands", "app"),
    "train": ("train", "train"),
    "grid": ("grid", "grid"),
    "storage": ("storage", "app"),
    "backup": ("backup", "backup"),
    "restore": ("backup", "restore"),
    "verify": ("verify", "verify"),
    "rebuild-catalog": ("rebuild", "rebuild_catalog"),
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
