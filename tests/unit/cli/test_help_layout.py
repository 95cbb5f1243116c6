"""`--help` of every command in 80 columns."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
import typer
from rich.table import Table

from services.cli.main import build_app


def walk(command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    subcommands = getattr(command, "commands", {})
    for name, subcommand in subcommands.items():
        yield from walk(subcommand, (*path, name))
    if not subcommands:
        yield path, command


def test_the_help_of_every_command_names_all_options_in_full_and_fills_its_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("typer.rich_utils.Table", Table)
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 80)
    program: Any = typer.main.get_command(build_app())
    for path, command in walk(program, ()):
        program.main([*path, "--help"], standalone_mode=False)
        shown = capsys.readouterr().out
        assert "…" not in shown, path
        for parameter in command.params:
            for name in parameter.opts:
                assert not name.startswith("--") or name in shown, (path, name)
        text = "\n".join(map(str.rstrip, shown.splitlines()))
        for paragraph in text.partition("╭")[0].strip().split("\n\n")[1:]:
            for line, following in pairwise(paragraph.splitlines()):
                assert len(line) + 1 + len(following.split()[0]) > 79, (path, line)
