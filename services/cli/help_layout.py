"""Layout of `--help` in a narrow terminal: whole option names, and paragraphs filled to its width.

Typer gives names, negations and types a column each and the description what is left, cuts long
option names, and keeps the line breaks of a docstring in all paragraphs but the first.
"""

from __future__ import annotations

import inspect
import re
from typing import Any

from rich.table import Table
from rich.text import Text
from typer import rich_utils

NAME_COLUMNS = 36
"""Most columns of an option's names and type, which wrap: the longest name has 35."""


class OptionsTable(Table):
    """A table of options in two columns: names with the type, and the description."""

    def add_row(self, *cells: Any, **styles: Any) -> None:
        if len(cells) < 6:  # a command: its name and description
            return super().add_row(*cells, **styles)
        *required, name, short, negation, short_negation, value_type, description = cells
        names = [name, short, negation, short_negation]
        if value_type.plain != "<bool>":  # a flag has no value
            names.append(value_type)
        cell = Text(" ", overflow="fold").join(text for text in names if text.plain)
        super().add_row(*required, cell, description, **styles)
        self.columns[-2].max_width = NAME_COLUMNS
        for text in getattr(description, "renderables", ()):
            text.overflow = "fold"
        return None


def prepare_help(command: Any) -> None:
    """Lay out the help of a command and of all commands below it."""
    rich_utils.Table = OptionsTable  # type: ignore[attr-defined]
    command.help = re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(command.help or ""))
    for subcommand in getattr(command, "commands", {}).values():
        prepare_help(subcommand)
