"""The Makefile: what each target installs."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def make(folder: Path, *arguments: str) -> str:
    """The commands that `make` would run in a folder with the Makefile."""
    return subprocess.run(
        ["make", "--dry-run", *arguments], cwd=folder, capture_output=True, text=True, check=True
    ).stdout


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name in ("Makefile", "pyproject.toml", "requirements.lock"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / ".venv").mkdir()
    return tmp_path


def test_make_run_installs_what_running_needs_and_make_test_everything(checkout: Path) -> None:
    to_run, to_test = make(checkout, "run"), make(checkout, "test")
    extras = "--editable '.[embedded,heic,onnx,pose,tracks]'"
    assert extras in to_run
    assert "--all-extras" not in to_run
    assert to_test.index(extras) < to_test.index("--all-extras")


def test_make_run_installs_nothing_after_make_test_or_itself(checkout: Path) -> None:
    (checkout / ".venv" / ".runnable").touch()
    assert "pip install" not in make(checkout, "run")
    assert "--all-extras" in make(checkout, "test")
    (checkout / ".venv" / ".installed").touch()
    assert "pip install" not in make(checkout, "run", "test")
    assert "PLACEWISE_HOME='/a b' exec" in make(checkout, "run", "PLACEWISE_HOME=/a b")


def test_a_build_of_pytorch_is_installed_first_and_kept_by_later_targets(checkout: Path) -> None:
    index = "https://index.example/cpu"
    commands = make(checkout, "run", f"TORCH_INDEX={index}")
    assert commands.index(f"--index-url {index}") < commands.index("--editable")
    assert f"{index} > .venv/torch-index" in commands
    (checkout / ".venv" / "torch-index").write_text(f"{index}\n")
    assert f"--index-url {index}" in make(checkout, "setup")
