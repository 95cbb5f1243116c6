"""The options of `placewise train`, made from the class of its arguments.

Underscores and hyphens are both accepted; the help shows the predecessor's underscores. A
true-or-false option stands alone (`--pretrained`), negated (`--no-pretrained`) or before a word
(`--pretrained False`), as the predecessor's commands write it.
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
    """Give a command that takes `**arguments` one option of text for each training argument.

    What is left out comes as None; `chosen` drops it.
    """
    own = [
        parameter
        for parameter in inspect.signature(command, eval_str=True).parameters.values()
        if parameter.kind is not inspect.Parameter.VAR_KEYWORD
    ]
    made = [
        _make_option(name)
        for name in sorted(ARGUMENT_NAMES, key=lambda n: GROUP_ORDER.index(argument_group(n)))
    ]
    shaped: Any = command
    shaped.__signature__ = inspect.Signature([*own, *made])
    shaped.__annotations__ = {each.name: each.annotation for each in [*own, *made]}
    shaped.command_settings = {"cls": TrainingCommand}
    return command


def given_options(arguments: dict[str, str | None]) -> dict[str, str]:
    """What the command line said, without what it left out."""
    return {name: text for name, text in arguments.items() if text is not None}


def _make_option(name: str) -> inspect.Parameter:
    field = TrainingArguments.model_fields[name]
    shown = field.default
    default = (
        "" if shown in (None, ()) or name == "cities" else f" (default: {_format_default(shown)})"
    )
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
        return f"({', '.join(str(each) for each in value)})"
    return str(value)


class TrainingCommand(TyperCommand):
    """Reads the tokens as the predecessor's users write them."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        own = [text for parameter in self.params for text in parameter.opts]
        return super().parse_args(ctx, normalise_tokens(args, own))


def normalise_tokens(tokens: Sequence[str], own_options: Sequence[str] = ()) -> list[str]:
    """The same command line with one token `--name=value` for each training argument.

    `own_options` are the command's other options, which stay as they are, with their values. Raises
    typer.BadParameter for an option that there is not.
    """
    left, done = list(tokens), []
    while left:
        token = left.pop(0)
        name, given, value = token.removeprefix("--").partition("=")
        if not token.startswith("--") or not name:
            done.append(token)
            continue
        negated = name.removeprefix("no-").removeprefix("no_")
        if negated != name and not given and _is_boolean_argument(negated):
            done.append(f"--{resolve_name(negated)}=false")
            continue
        try:
            known = resolve_name(name)
        except InvalidRequest:
            if f"--{name}" not in (*own_options, "--help"):
                options = [*(text.removeprefix("--") for text in own_options), *ARGUMENT_NAMES]
                raise typer.BadParameter(
                    f"There is no option --{name}.{suggest_name(name, options)}"
                ) from None
            done.append(token)
            continue
        if not given:
            value = _pop_value(known, left)
        done.append(f"--{known}={value}")
    return done


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
        raise typer.BadParameter(f"--{name} needs a value.")
    value = remaining.pop(0)
    if (
        name in SIZE_ARGUMENTS
        and remaining
        and all(re.fullmatch(r"\d+", n) for n in (value, remaining[0]))
    ):
        value = f"{value} {remaining.pop(0)}"
    return value
