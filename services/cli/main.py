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
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from services.cli import collection_paused

Commands = dict[str, tuple[str, str, str]]
"""Name of a command -> its panel in the help, module and attribute"""

# In the order of the help.
PANELS = {
    "Photos and maps": {
        "index": "services.cli.ingest.index:index",
        "query": "services.cli.query:query",
        "track": "services.cli.track.command:track",
        "locate": "services.cli.locate.command:locate",
        "immich": "services.cli.immich.command:immich",
        "reconstruct": "services.cli.reconstruct:reconstruct",
        "export": "services.cli.export:app",
        "maps": "services.cli.maps:app",
    },
    "Descriptors and accuracy": {
        "vocabulary": "services.cli.descriptors.vocabulary:app",
        "models": "services.cli.descriptors.models:app",
        "evaluate": "services.cli.evaluate:evaluate",
    },
    "Services": {
        "serve": "services.cli.operations.servers:serve",
        "gateway": "services.cli.operations.servers:gateway",
        "extractor": "services.cli.operations.servers:extractor",
        "search": "services.cli.operations.servers:search",
        "steward": "services.cli.operations.servers:steward",
    },
    "Operation": {
        "config": "services.cli.environment:config",
        "doctor": "services.cli.operations.doctor:doctor",
        "jobs": "services.cli.jobs:jobs",
        "keys": "services.cli.operations.keys:app",
        "storage": "services.cli.operations.storage:app",
    },
}
# The lab's commands exist where `lab` stands beside `services`: in a clone of the repository, but
# in no image. Its `evaluate` adds data sets to that of the service.
LAB_PANEL = "Descriptors and accuracy"
LAB_COMMANDS = {
    "describe": "lab.cli.descriptors.describe:describe",
    "evaluate": "lab.cli.evaluation.commands:evaluate",
    "compare": "lab.cli.evaluation.commands:compare",
    "train": "lab.cli.training.commands:train",
    "grid": "lab.cli.training.commands:grid",
    "datasets": "lab.cli.datasets.commands:app",
    "bench": "lab.cli.bench:app",
}
ROOT = Path(__file__).parents[2]


def list_commands(root: Path = ROOT) -> Commands:
    """List the commands that are installed.

    Args:
        root: Folder of the packages `services` and, where it is installed, `lab`.
    """
    has_lab = (root / "lab" / "cli" / "__init__.py").is_file()
    found: Commands = {}
    for panel, commands in PANELS.items():
        of_the_lab = LAB_COMMANDS if has_lab and panel == LAB_PANEL else {}
        for name, target in (commands | of_the_lab).items():
            module, _, attribute = target.partition(":")
            found[name] = panel, module, attribute
    return found


COMMANDS = list_commands()


class _ListingGroup(TyperGroup):
    """Lists its commands by panel, each with the whole first paragraph of its help."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        commands: list[Any] = [self.get_command(ctx, name) for name in self.list_commands(ctx)]
        for panel in dict.fromkeys(command.rich_help_panel for command in commands):
            with formatter.section(panel or "Commands"):
                listed = [command for command in commands if command.rich_help_panel == panel]
                texts = [(each.name, each.help.partition("\n\n")[0]) for each in listed]
                formatter.write_dl([(name, " ".join(text.split())) for name, text in texts])


class _PlacewiseGroup(_ListingGroup):
    """Reports the error of a command in one line, as JSON with `--json`, and exits with code 1."""

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
            from services.cli.environment import packages_missing
            from services.cli.output import AS_JSON, report_error  # the help does not need rich

            package = (getattr(error, "name", None) or "").partition(".")[0]
            is_missing = isinstance(error, ModuleNotFoundError) and find_spec(package) is None
            reported = packages_missing(package) if is_missing else error
            if report_error(reported, ctx.meta.get(AS_JSON, False)):
                raise typer.Exit(1) from error
            raise


def build_app(names: Collection[str] | None = None, commands: Commands = COMMANDS) -> typer.Typer:
    """Build the application with the named commands, or all, importing only their modules."""
    from services.cli.option_groups import with_single_options

    app = _new_app()
    for name in commands if names is None else names:
        panel, module, attribute = commands[name]
        command = getattr(importlib.import_module(module), attribute)
        if isinstance(command, typer.Typer):
            group = command.info.cls or _ListingGroup
            app.add_typer(command, name=name, cls=group, rich_help_panel=panel)
        else:
            app.command(name, rich_help_panel=panel, **getattr(command, "command_settings", {}))(
                with_single_options(command)
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
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    names = sys.argv[1:2]
    if sys.argv[1:] in ([], ["--help"], ["--version"]):
        app = _build_overview()
    else:
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
        rich_markup_mode=None,
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
