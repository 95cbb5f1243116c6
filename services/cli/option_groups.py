"""Options that several commands share, declared once, as the fields of a dataclass."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import typer


class CommandGroup(typer.Typer):
    """A Typer application whose commands may have parameters that are groups of options.

    The type of such a parameter is a dataclass. Each of its fields is an option, listed after those
    of the command itself.
    """

    def command(self, *args: Any, **kwargs: Any) -> Callable[[Any], Any]:
        """Register a command, as `typer.Typer.command` does."""
        register = super().command(*args, **kwargs)

        def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
            register(with_single_options(command))
            return command

        return decorate


def with_single_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return the command with a parameter for each option of its groups, as Typer expects it."""
    parameters = inspect.signature(command, eval_str=True).parameters.values()
    own = [each for each in parameters if not is_dataclass(each.annotation)]
    groups: dict[str, Any] = {
        each.name: each.annotation for each in parameters if is_dataclass(each.annotation)
    }
    if not groups:
        return command

    @functools.wraps(command)
    def run(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{each.name: values.pop(each.name) for each in fields(group)})
        command(**values)

    for group in groups.values():
        own += inspect.signature(group, eval_str=True).parameters.values()
    single = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in own]
    run.__signature__ = inspect.Signature(single)  # type: ignore[attr-defined]
    return run
