"""Limits of sizes bind before lines are written: commits to a copy of the repository."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tools.size import ROOMS, ROOT, ROW, find_late_raises, measure

LINE = '"""More."""\n'


class Clone:
    """A clone of a repository whose figures are at their limits."""

    def __init__(self, origin: Path, folder: Path, *options: str) -> None:
        self.folder = folder
        run_git(origin, "clone", "--quiet", *options, origin.as_uri(), str(folder))

    def add_lines(self, count: int) -> None:
        (self.folder / "lab/more.py").write_text(LINE * count)

    def raise_limit(self, lines: int) -> None:
        page = self.folder / "docs/architecture.md"
        before, name, after = page.read_text().partition("| lines of the lab | ")
        limit, bar, after = after.partition(" |")
        page.write_text(f"{before}{name}{int(limit) + lines}{bar}{after}")

    def add_record(self) -> None:
        (self.folder / "docs/decisions/9999-more.md").write_text("# More lines of the lab\n")

    def commit(self, *options: str) -> subprocess.CompletedProcess[str]:
        run_git(self.folder, "add", "--all")
        return run_git(self.folder, "commit", "--quiet", "--message=More", *options, check=False)

    def check(self) -> str:
        return "\n".join(find_late_raises(self.folder))


def run_git(folder: Path, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    identity = ("-c", "user.name=Test", "-c", "user.email=test@example.org")
    outside = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    return subprocess.run(
        ("git", *identity, *arguments),
        cwd=folder,
        env={**outside, "GIT_CONFIG_GLOBAL": os.devnull, "SKIP": "lint-imports"},
        capture_output=True,
        text=True,
        check=check,
    )


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository with a copy of the service, and the figures of that code as limits."""
    folder = tmp_path_factory.mktemp("size") / "origin"
    folder.mkdir()
    files = [path for top in ROOMS["service"] for path in (ROOT / top).rglob("*.py")]
    names = ("pyproject.toml", ".pre-commit-config.yaml", ".gitignore", "docs/architecture.md")
    for file in [*files, *map(ROOT.joinpath, names), ROOT / "docs/decisions/README.md"]:
        copy = folder / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    (folder / "lab").mkdir()
    (folder / "lab/some.py").write_text(LINE)
    page, figures = folder / "docs/architecture.md", measure(folder)
    rows = ROW.sub(lambda row: f"| {row[1]} | {figures[row[1]]} | {row[3]} |", page.read_text())
    page.write_text(rows)
    run_git(folder, "init", "--quiet")
    run_git(folder, "add", "--all")
    run_git(folder, "commit", "--quiet", "--message=Start")
    return folder


@pytest.fixture
def clone(origin: Path, tmp_path: Path) -> Clone:
    return Clone(origin, tmp_path / "clone")


def test_the_pre_commit_hook_refuses_a_commit_above_a_limit(clone: Clone) -> None:
    (clone.folder / ".venv").symlink_to(sys.prefix)
    subprocess.run((f"{sys.prefix}/bin/pre-commit", "install"), cwd=clone.folder, check=True)
    clone.add_lines(1)
    refused = clone.commit()
    assert refused.returncode == 1
    assert "is above the limit" in refused.stdout + refused.stderr
    assert run_git(clone.folder, "rev-list", "--count", "HEAD").stdout == "1\n"


def test_make_lint_checks_the_sizes() -> None:
    commands = subprocess.run(
        ("make", "--dry-run", "lint"), cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "python -m tools.size\n" in commands.stdout


@pytest.mark.parametrize("committed", [False, True])
def test_a_change_that_raises_a_limit_adds_no_lines(clone: Clone, committed: bool) -> None:
    clone.raise_limit(10)
    clone.add_record()
    clone.add_lines(1)
    if committed:
        clone.commit("--no-verify")
    else:
        run_git(clone.folder, "add", "--all")
    assert "changes Python files" in clone.check()


def test_a_limit_is_not_raised_to_the_figure_of_earlier_commits(clone: Clone) -> None:
    clone.add_lines(10)
    clone.commit("--no-verify")
    clone.raise_limit(10)
    clone.add_record()
    clone.commit("--no-verify")
    assert "had exceeded before" in clone.check()


def test_a_raise_that_later_commits_follow_is_examined(clone: Clone) -> None:
    clone.raise_limit(10)
    clone.commit("--no-verify")
    clone.add_lines(1)
    clone.raise_limit(-1)
    clone.commit("--no-verify")
    assert "without adding a decision record" in clone.check()


def test_a_capability_raises_the_limit_adds_its_lines_later_and_is_merged(clone: Clone) -> None:
    run_git(clone.folder, "checkout", "--quiet", "-b", "capability")
    clone.raise_limit(10)
    clone.add_record()
    run_git(clone.folder, "add", "--all")
    assert clone.check() == ""
    clone.commit()
    clone.add_lines(10)
    clone.commit()
    assert clone.check() == ""
    run_git(clone.folder, "checkout", "--quiet", "-")
    run_git(clone.folder, "merge", "--quiet", "--no-ff", "--no-commit", "capability")
    assert clone.check() == ""
    clone.commit()
    assert clone.check() == ""


def test_a_shallow_clone_and_an_archive_are_measured(origin: Path, tmp_path: Path) -> None:
    clone = Clone(origin, tmp_path / "clone")
    clone.raise_limit(10)
    clone.add_record()
    clone.commit()
    shallow = Clone(clone.folder, tmp_path / "shallow", "--depth=1")
    assert shallow.check() == ""
    shutil.rmtree(shallow.folder / ".git")
    command = (sys.executable, "-m", "tools.size")
    archive = subprocess.run(command, cwd=shallow.folder, capture_output=True, text=True)
    assert archive.returncode == 0, archive.stderr
    assert "The history was not examined" in archive.stderr
