"""`--help` of every command in 80 columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import typer

from services.cli.main import build_app


def walk(command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    subcommands = getattr(command, "commands", {})
    for name, subcommand in subcommands.items():
        yield from walk(subcommand, (*path, name))
    if not subcommands:
        yield path, command


def test_the_help_of_every_command_names_all_options_in_full_in_80_columns(
    capsys: pytest.CaptureFixture[str],
) -> None:
    program: Any = typer.main.get_command(build_app())
    for path, command in walk(program, ()):
        program.main([*path, "--help"], standalone_mode=False)
        shown = capsys.readouterr().out
        assert max(map(len, shown.splitlines())) <= 80, path
        for parameter in command.params:
            for name in parameter.opts:
                assert not name.startswith("--") or name in shown, (path, name)
                assert "_" not in name or not name.startswith("--"), (path, name)


def test_options_and_commands_are_accepted_with_hyphens_and_underscores(
    capsys: pytest.CaptureFixture[str],
) -> None:
    program: Any = typer.main.get_command(build_app())
    program.main(["storage", "create_bucket", "--help"], standalone_mode=False)
    assert "create-bucket" in capsys.readouterr().out
    for option in ("--top-k", "--top_k"):
        with pytest.raises(SystemExit, match="2"):
            program.main(["query", __file__, option, "many"])
        assert "Invalid value for '--top-k'" in capsys.readouterr().err


def test_every_command_is_in_a_panel_of_the_overview(capsys: pytest.CaptureFixture[str]) -> None:
    program: Any = typer.main.get_command(build_app())
    program.main(["--help"], standalone_mode=False)
    shown = capsys.readouterr().out
    assert "Commands:" not in shown
    assert all(f"\n  {name} " in shown for name in program.commands)
