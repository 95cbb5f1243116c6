"""Commands of the lab exist where the lab is installed; elsewhere they say what to install."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from services.cli.main import COMMANDS, LAB_COMMANDS, build_app, list_commands


def test_a_clone_has_the_commands_of_the_lab() -> None:
    for name, target in LAB_COMMANDS.items():
        assert ":".join(COMMANDS[name][1:]) == target


def test_without_the_lab_only_its_commands_are_missing(tmp_path: Path) -> None:
    found = list_commands(tmp_path)
    assert set(COMMANDS) - set(found) == set(LAB_COMMANDS) - {"evaluate"}
    assert {module.partition(".")[0] for _, module, _ in found.values()} == {"services"}


@pytest.mark.parametrize("name", sorted(set(LAB_COMMANDS) - {"evaluate"}))
def test_without_the_lab_its_commands_name_it(name: str, tmp_path: Path) -> None:
    app = build_app(["maps", "query"], list_commands(tmp_path))
    ended = CliRunner().invoke(app, [name, "--any", "option"])
    assert ended.exit_code == 1
    assert f"lab_missing: `placewise {name}` is part of the lab" in " ".join(ended.output.split())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["evaluate", "--data", "folder"], "--data"),
        (["evaluate", "--predictions", "file"], "--predictions"),
    ],
)
def test_without_the_lab_commands_name_it_for_data_sets(
    arguments: list[str], named: str, tmp_path: Path
) -> None:
    app = build_app(["evaluate", "maps"], list_commands(tmp_path))
    ended = CliRunner().invoke(app, [*arguments, "--json"])
    assert ended.exit_code == 1
    problem = json.loads(ended.output)
    assert problem["code"] == "lab_missing"
    assert named in problem["detail"]
