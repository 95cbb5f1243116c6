"""Commands that are shown to a user."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

import pytest

from shared.config.command_line import command_line


def test_a_shown_command_has_absolute_paths_that_a_shell_reads_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "my photos"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [".venv/bin/placewise", "locate", "."])
    program = f"{folder}/.venv/bin/placewise"
    shown = command_line("locate", Path("day 1"), "--undo")
    assert shlex.split(shown) == [program, "locate", f"{folder}/day 1", "--undo"]
    shown = command_line("query", "PHOTO", home=Path("var"))
    assert shlex.split(shown) == [f"PLACEWISE_HOME={folder}/var", program, "query", "PHOTO"]


def test_a_shown_command_can_be_printed_if_a_path_is_not_utf_8(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["/bin/placewise"])
    shown = command_line("locate", Path(os.fsdecode(b"/caf\xe9")))
    assert shown == "/bin/placewise locate '/caf\N{REPLACEMENT CHARACTER}'"
