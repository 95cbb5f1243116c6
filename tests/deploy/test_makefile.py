"""The Makefile: what each target installs."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
EXTRAS = "embedded,heic,onnx,pose,tracks"
# Runs a command where some packages are not found.
WITHOUT = """
import sys
from importlib.machinery import PathFinder

class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name in missing else super().find_spec(name, path, target)

missing = set(sys.argv.pop(1).split(","))
sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
from services.cli import main
main()
"""


def required_names(requirement: Requirement, seen: set[str]) -> set[str]:
    """The distributions that a requirement and what is installed for it bring."""
    if str(requirement) in seen:
        return set()
    seen.add(str(requirement))
    names: set[str] = {canonicalize_name(requirement.name)}
    with contextlib.suppress(PackageNotFoundError):  # left out by tool.uv
        for each in map(Requirement, requires(requirement.name) or []):
            marker, each.marker = each.marker, None
            extras = requirement.extras or {""}
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
                names |= required_names(each, seen)
    return names


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
    extras = f"--editable '.[{EXTRAS}]'"
    assert extras in to_run
    assert "--all-extras" not in to_run
    assert to_test.index(extras) < to_test.index("--all-extras")


def test_the_generated_city_of_the_readme_needs_no_more_than_make_run_installs(
    tmp_path: Path,
) -> None:
    installed = required_names(Requirement(f"placewise[{EXTRAS}]"), set())
    missing = [
        module
        for module, names in packages_distributions().items()
        if not set(map(canonicalize_name, names)) & installed
    ]
    assert "scipy" in missing

    def placewise(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", WITHOUT, ",".join(missing), *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )

    small = ("--places", "2", "--views", "1", "--size", "96x72", "--no-train")
    drawn = placewise("datasets", "synth", "city", *small)
    assert drawn.returncode == 0, drawn.stderr
    assert list((tmp_path / "city/database").glob("*.jpg"))
    checked = placewise("datasets", "check", "city")
    assert checked.returncode == 1
    assert checked.stderr.startswith("lab_missing: This command requires scipy."), checked.stderr


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
