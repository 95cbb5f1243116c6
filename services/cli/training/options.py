"""Command-line options of `placewise train`, generated from `TrainingArguments`.

Underscores and hyphens are both accepted; the help shows underscores, as in GSV-Cities scripts. A
boolean option is written alone (`--pretrained`), negated (`--no-pretrained`) or with a value
(`--pretrained False`), for compatibility with those scripts.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from services.trainer.arguments import (
    ARGUMENT_NAMES,
    FALSE_WORDS,
    TRUE_WORDS,
    TrainingArguments,
    argument_group,
    is_boolean,
    resolve_name,
    suggest_name,
)
from shared.errors import InvalidRequest

SIZE_ARGUMENTS = ("image_size", "test_image_size")
GROUP_ORDER = (
    "Data",
    "Model",
    "Loss and miner",
    "Optimisation",
    "Evaluation",
    "Checkpoints",
    "Machine",
    "Run",
)


def with_training_options(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command that takes `**arguments` with a text option per training argument.

    Options that are not given are passed as None; `given_options` removes them.
    """
    own_parameters = [
        parameter
        for parameter in inspect.signature(command, eval_str=True).parameters.values()
        if parameter.kind is not inspect.Parameter.VAR_KEYWORD
    ]
    training_parameters = [
        _make_option(name)
        for name in sorted(ARGUMENT_NAMES, key=lambda n: GROUP_ORDER.index(argument_group(n)))
    ]
    parameters = [*own_parameters, *training_parameters]
    decorated: Any = command
    decorated.__signature__ = inspect.Signature(parameters)
    decorated.__annotations__ = {p.name: p.annotation for p in parameters}
    decorated.command_settings = {"cls": TrainingCommand}
    return command


def given_options(arguments: dict[str, str | None]) -> dict[str, str]:
    """The options that were given on the command line."""
    return {name: text for name, text in arguments.items() if text is not None}


def _make_option(name: str) -> inspect.Parameter:
    field = TrainingArguments.model_fields[name]
    default = ""
    if field.default not in (None, ()) and name != "cities":
        default = f" (default: {_format_default(field.default)})"
    option = typer.Option(
        f"--{name}",
        help=f"{field.description}{default}",
        rich_help_panel=argument_group(name),
        metavar="BOOL" if is_boolean(name) else "VALUE",
        show_default=False,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[str | None, option],
    )


def _format_default(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(str(item) for item in value)})"
    return str(value)


class TrainingCommand(TyperCommand):
    """Parses boolean and size options as GSV-Cities scripts write them."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        own_options = [text for parameter in self.params for text in parameter.opts]
        return super().parse_args(ctx, normalise_tokens(args, own_options))


def normalise_tokens(tokens: Sequence[str], own_options: Sequence[str] = ()) -> list[str]:
    """Rewrite a command line to one token `--name=value` per training argument.

    Args:
        tokens: The command line.
        own_options: The command's other options, which are left unchanged with their values.

    Raises:
        typer.BadParameter: Unknown option or missing value.
    """
    remaining, normalised = list(tokens), []
    while remaining:
        token = remaining.pop(0)
        name, has_value, value = token.removeprefix("--").partition("=")
        if not token.startswith("--") or not name:
            normalised.append(token)
            continue
        negated = name.removeprefix("no-").removeprefix("no_")
        if negated != name and not has_value and _is_boolean_argument(negated):
            normalised.append(f"--{resolve_name(negated)}=false")
            continue
        try:
            known = resolve_name(name)
        except InvalidRequest:
            if f"--{name}" not in (*own_options, "--help"):
                options = [*(text.removeprefix("--") for text in own_options), *ARGUMENT_NAMES]
                raise typer.BadParameter(
                    f"Unknown option --{name}.{suggest_name(name, options)}"
                ) from None
            normalised.append(token)
            continue
        if not has_value:
            value = _pop_value(known, remaining)
        normalised.append(f"--{known}={value}")
    return normalised


def _is_boolean_argument(name: str) -> bool:
    name = name.replace("-", "_")
    return name in ARGUMENT_NAMES and is_boolean(name)


def _pop_value(name: str, remaining: list[str]) -> str:
    if is_boolean(name):
        return (
            remaining.pop(0)
            if remaining and remaining[0].strip().lower() in TRUE_WORDS | FALSE_WORDS
            else "true"
        )
    if not remaining:
        raise typer.BadParameter(f"--{name} requires a value.")
    value = remaining.pop(0)
    if (
        name in SIZE_ARGUMENTS
        and remaining
        and all(re.fullmatch(r"\d+", n) for n in (value, remaining[0]))
    ):
        value = f"{value} {remaining.pop(0)}"
    return value
