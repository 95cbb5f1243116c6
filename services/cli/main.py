"""The Typer application of `placewise`, with lazily imported commands.

A run imports only the module of the command it executes: some commands load torch, which
takes seconds and is not installed in every image.
"""

from __future__ import annotations

import ast
import importlib
import logging
import sys
from collections.abc import Collection
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

# Panel of the help -> command -> (module below services.cli, attribute), in the order of the help.
PANELS = {
    "Photos and maps": {
        "index": ("ingest.index", "index"),
        "query": ("query", "query"),
        "track": ("track.command", "track"),
        "locate": ("locate.command", "locate"),
        "export": ("export", "app"),
        "maps": ("maps", "app"),
    },
    "Descriptors and accuracy": {
        "vocabulary": ("descriptors.vocabulary", "app"),
        "pca": ("descriptors.pca", "app"),
        "models": ("descriptors.models", "app"),
        "describe": ("descriptors.describe", "describe"),
        "evaluate": ("evaluation.command", "evaluate"),
    },
    "Services": {
        "serve": ("operations.servers", "serve"),
        "gateway": ("operations.servers", "gateway"),
        "extractor": ("operations.servers", "extractor"),
        "search": ("operations.servers", "search"),
        "steward": ("operations.servers", "steward"),
        "migrate": ("operations.servers", "migrate"),
        "config": ("environment", "config"),
        "doctor": ("operations.doctor", "doctor"),
    },
    "Operation": {
        "keys": ("operations.keys", "app"),
        "storage": ("operations.storage", "app"),
        "verify": ("operations.storage", "verify"),
        "backup": ("operations.backup", "backup"),
        "restore": ("operations.backup", "restore"),
        "rebuild-catalog": ("operations.backup", "rebuild_catalog"),
    },
}
# The lab's commands, as above, below lab.cli. They exist where `lab` stands beside `services`: in a
# clone of the repository, but in no image. Its `evaluate` replaces that of the service.
LAB_PANEL = "Descriptors and accuracy"
LAB_COMMANDS = {
    "evaluate": ("evaluation.commands", "evaluate"),
    "compare": ("evaluation.commands", "compare"),
    "train": ("training.commands", "train"),
    "grid": ("training.commands", "grid"),
    "datasets": ("datasets.commands", "app"),
    "bench": ("bench", "app"),
}
ROOT = Path(__file__).parents[2]


Commands = dict[str, tuple[str, str, str]]
"""Name of a command -> its panel, module and attribute"""


def list_commands(root: Path = ROOT) -> Commands:
    """List the commands that are installed.

    Args:
        root: Folder of the packages `services` and, where it is installed, `lab`.
    """
    has_lab = (root / "lab" / "cli" / "__init__.py").is_file()
    found: Commands = {}
    for panel, commands in PANELS.items():
        for name, (module, attribute) in commands.items():
            found[name] = (panel, f"services.cli.{module}", attribute)
        if has_lab and panel == LAB_PANEL:
            for name, (module, attribute) in LAB_COMMANDS.items():
                found[name] = (panel, f"lab.cli.{module}", attribute)
    return found


COMMANDS = list_commands()


class _PlacewiseGroup(TyperGroup):
    """Reports the error of a command in one line, as JSON with `--json`, and exits with code 1."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or "--help" in args:
            from services.cli.help_layout import prepare_help  # only the help needs it

            prepare_help(self)
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = _use_hyphens(args[0])
        if name in LAB_COMMANDS and self.get_command(ctx, name) is None:
            from services.cli.environment import lab_missing

            raise lab_missing(f"`placewise {name}`")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except Exception as error:
            from services.cli.output import AS_JSON, report_error  # the help does not need rich

            if report_error(error, ctx.meta.get(AS_JSON, False)):
                raise typer.Exit(1) from error
            raise


def build_app(names: Collection[str] | None = None, commands: Commands = COMMANDS) -> typer.Typer:
    """Build the application with the named commands, or all, importing only their modules."""
    app = _new_app()
    for name in commands if names is None else names:
        panel, module, attribute = commands[name]
        command = getattr(importlib.import_module(module), attribute)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=panel)
        else:
            app.command(name, rich_help_panel=panel, **getattr(command, "command_settings", {}))(
                command
            )
    return app


def _build_overview() -> typer.Typer:
    """Build the application for its own help: its commands do nothing.

    The help texts are read from the source, because importing all commands takes over a second.
    """
    app = _new_app()
    for name, (panel, module, attribute) in COMMANDS.items():
        path = ROOT / f"{module.replace('.', '/')}.py"
        for node in ast.parse(path.read_bytes()).body:
            if isinstance(node, ast.FunctionDef) and node.name == attribute:
                text = ast.get_docstring(node)
                app.command(name, help=text, rich_help_panel=panel)(_root_callback)
            elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == attribute:
                assert isinstance(node.value, ast.Call)  # app = typer.Typer(help=...)
                options = {option.arg: option.value for option in node.value.keywords}
                text = ast.literal_eval(options["help"])
                app.add_typer(typer.Typer(), name=name, help=text, rich_help_panel=panel)
    return app


def run() -> None:
    """Parse the command line and run the command."""
    logging.basicConfig(
        level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    names = sys.argv[1:2]
    if sys.argv[1:] in ([], ["--help"], ["--version"]):
        app = _build_overview()
    else:
        from services.cli.imports import collection_paused

        # The suggestion of a similar name, for a typo, needs every command.
        with collection_paused():
            app = build_app(names if names[0] in COMMANDS else None)
    app()


def _new_app() -> typer.Typer:
    app = typer.Typer(
        name="placewise",
        cls=_PlacewiseGroup,
        help="Self-hosted visual place recognition: find where a photo was taken.",
        no_args_is_help=True,
        context_settings={"token_normalize_func": _use_hyphens},
        pretty_exceptions_enable=False,
        add_completion=False,
    )
    app.callback()(_root_callback)
    return app


def _use_hyphens(name: str) -> str:
    """Accept underscores in the names of commands and options."""
    return name.replace("_", "-")


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"placewise {version('placewise')}")
        raise typer.Exit


def _root_callback(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version and exit.", is_eager=True, callback=_print_version
        ),
    ] = False,
) -> None:
    """Self-hosted visual place recognition: find where a photo was taken."""
