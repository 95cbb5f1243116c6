"""Layout of `--help` in a narrow terminal: whole option names, and paragraphs filled to its width.

Typer cuts long option names, and keeps the line breaks of a docstring in all paragraphs but the
first.
"""

from __future__ import annotations

import inspect
import re
from typing import Any

from rich.table import Table
from typer import rich_utils


class OptionsTable(Table):
    """A table of options: names keep their width; types and descriptions wrap and lose nothing."""

    def add_row(self, *cells: Any, **styles: Any) -> None:
        super().add_row(*cells, **styles)
        for column in self.columns[:-2]:
            column.no_wrap = True
        for text in getattr(cells[-1], "renderables", ()):
            text.overflow = "fold"


def prepare_help(command: Any) -> None:
    """Lay out the help of a command and of all commands below it."""
    rich_utils.Table = OptionsTable  # type: ignore[attr-defined]
    command.help = re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(command.help or ""))
    for subcommand in getattr(command, "commands", {}).values():
        prepare_help(subcommand)
