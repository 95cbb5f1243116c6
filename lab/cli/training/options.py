"""Command-line options of `placewise train`, generated from `TrainingArguments`.

Hyphens and underscores, as in GSV-Cities scripts, are both accepted; the help shows hyphens. A
boolean option is written alone (`--pretrained`), negated (`--no-pretrained`) or with a value
(`--pretrained False`), for compatibility with those scripts.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from lab.training.arguments import TrainingArguments, argument_groups, normalise_name

FIELDS = TrainingArguments.model_fields
BOOLEANS = {name for name, field in FIELDS.items() if field.annotation is bool}
SIZES = ("image_size", "val_image_size", "test_image_size")


def with_training_options(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command that takes `**arguments` with a text option per training argument.

    Options that are not given are passed as None; `given_options` removes them.
    """
    own_parameters = [
        parameter
        for parameter in inspect.signature(command, eval_str=True).parameters.values()
        if parameter.kind is not inspect.Parameter.VAR_KEYWORD
    ]
    options = (_make_option(name, group) for name, group in argument_groups().items())
    parameters = [*own_parameters, *options]
    decorated: Any = command
    decorated.__signature__ = inspect.Signature(parameters)
    decorated.__annotations__ = {p.name: p.annotation for p in parameters}
    decorated.command_settings = {
        "cls": _TrainingCommand,
        "context_settings": {"token_normalize_func": _option_name},
    }
    return command


def given_options(arguments: dict[str, str | None]) -> dict[str, str]:
    """The options that were given on the command line."""
    return {name: text for name, text in arguments.items() if text is not None}


def _make_option(name: str, group: str) -> inspect.Parameter:
    field = FIELDS[name]
    description = " ".join(str(field.description).split())
    default = ""
    if field.default not in (None, ()) and name != "cities":
        default = f" (default: {_format_default(field.default)})"
    option = typer.Option(
        f"--{_option_name(name)}",
        help=f"{description}{default}",
        rich_help_panel=group,
        metavar="BOOL" if name in BOOLEANS else "VALUE",
        show_default=False,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[str | None, option],
    )


def _option_name(name: str) -> str:
    return normalise_name(name).replace("_", "-")


def _format_default(value: Any) -> str:
    return json.dumps(value) if isinstance(value, tuple) else str(value)


class _TrainingCommand(TyperCommand):
    """Accepts booleans and sizes as GSV-Cities scripts write them."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, _add_values(args))


def _add_values(tokens: Sequence[str]) -> list[str]:
    """Write a boolean option without a value, and the two numbers of a size, as `--name=value`."""
    remaining, rewritten = list(tokens), []
    while remaining:
        token = remaining.pop(0)
        name = normalise_name(token.removeprefix("--")) if token.startswith("--") else ""
        # A word is its value, right or wrong; a path is the file of `placewise grid`.
        has_value = remaining and remaining[0].isalnum()
        if name in BOOLEANS and not has_value:
            token = f"--{name}=true"
        elif name.startswith("no_") and name.removeprefix("no_") in BOOLEANS:
            token = f"--{name.removeprefix('no_')}=false"
        elif name in SIZES and [word.isdecimal() for word in remaining[:2]] == [True, True]:
            token = f"--{name}={remaining.pop(0)} {remaining.pop(0)}"
        rewritten.append(token)
    return rewritten
