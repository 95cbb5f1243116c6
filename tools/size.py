"""Prints the size of the code beside its limits, and fails where a limit is exceeded: `make size`.

The limits and aims are in a table of `docs/architecture.md`, and are edited by hand. Raising one is
a decision before the lines are written: the commit that raises a limit adds a decision record and
changes no Python file, and the lines that it finds are within the limits.
"""

from __future__ import annotations

import re
import signal
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path

from rich.table import Column

from services.cli.main import COMMANDS
from services.cli.output import Table, print_note, print_table
from shared.config.settings import Settings

ROOT = Path(__file__).parents[1]
PAGE = "docs/architecture.md"
RECORDS = "docs/decisions/"
HEADING = "## Size"
ROOMS = {
    "service": ("placewise", "services", "shared", "tools"),
    "lab": ("lab",),
    "tests": ("tests",),
}
MIGRATIONS = "shared/catalog/migrations/versions"
ROW = re.compile(r"^\| ([a-z ]+) \| ([\d,]+|-) \| ([\d,]+|-) \|$", re.MULTILINE)
ROW_OF_GIT = "^| [a-z ]* | [0-9,-]* | [0-9,-]* |$"


@dataclass(frozen=True, slots=True)
class Bound:
    """The limit and the aim of a figure; None where there is none."""

    limit: int | None
    aim: int | None


def measure(root: Path) -> dict[str, int]:
    """Count what the table bounds, in the repository's folder `root`."""
    figures: dict[str, int] = {}
    for room, folders in ROOMS.items():
        files = [path for folder in folders for path in (root / folder).rglob("*.py")]
        figures[f"lines of the {room}"] = sum(path.read_bytes().count(b"\n") for path in files)
        figures[f"files of the {room}"] = len(files)
    figures["settings"] = len(Settings.model_fields)
    figures["commands"] = len(COMMANDS)
    figures["migrations"] = len(list((root / MIGRATIONS).glob("*.py")))
    return figures


def read_bounds(page: str) -> dict[str, Bound]:
    """Read the table below `HEADING`, whose rows are `| figure | limit | aim |`."""
    _, heading, section = page.partition(f"\n{HEADING}\n")
    if not heading:
        raise SystemExit(f"{PAGE} has no heading `{HEADING}`.")
    section = section.partition("\n## ")[0]
    return {name: Bound(_number(limit), _number(aim)) for name, limit, aim in ROW.findall(section)}


def find_violations(figures: Mapping[str, int], bounds: Mapping[str, Bound]) -> list[str]:
    """Describe each figure above its limit, and each row of which the other side is missing."""
    found = [f"the table has no row `{name}`" for name in figures if name not in bounds]
    found += [f"nothing is counted for the row `{name}`" for name in bounds if name not in figures]
    for name, figure in figures.items():
        limit = bounds[name].limit if name in bounds else None
        if limit is not None and figure > limit:
            found.append(f"{name}: {figure:,} is above the limit of {limit:,}")
    return found


def find_late_raises(root: Path) -> list[str]:
    """Describe what is wrong with a raise in the working tree and with the last one in the history.

    Merges are not examined: they bring what their commits raised.

    Raises:
        OSError: Git is not installed.
        subprocess.CalledProcessError: the folder has no Git history.
    """
    found: list[str] = []
    if not (root / _git(root, "rev-parse", "--git-path", "MERGE_HEAD").strip()).exists():
        found = _examine_change(root, "HEAD", "") or []
    log = _git(root, "log", "--no-merges", f"-G{ROW_OF_GIT}", "--format=%H %P", "--", PAGE)
    for line in log.splitlines():
        commit, _, parent = line.partition(" ")
        examined = _examine_change(root, parent, commit) if parent else []  # a shallow clone's end
        if examined is not None:
            return found + examined
    return found


def _examine_change(root: Path, parent: str, commit: str) -> list[str] | None:
    """Describe what is wrong with the raise of a limit between `parent` and `commit`, which is the
    working tree where it is empty; None if no limit is raised."""
    before, after = _limits_at(root, parent), _limits_at(root, commit)
    raised = [name for name in before.keys() & after.keys() if before[name] < after[name]]
    if not raised:
        return None
    title = f"{commit[:10] or 'the working tree'} raises the limit of {', '.join(sorted(raised))}"
    changes = _git(root, "diff", "--name-status", "--no-renames", parent, *commit.split())
    found = []
    if ".py\n" in changes:
        found.append(f"{title}, and changes Python files: commit the raise alone, before them")
    if f"A\t{RECORDS}" not in changes:
        found.append(f"{title} without adding a decision record in {RECORDS}")
    for room in raised:
        lines = _lines_at(root, parent, room.removeprefix("lines of the "))
        if lines > before[room]:
            found.append(f"{title}, which {lines:,} lines had exceeded before")
    return found


def _limits_at(root: Path, commit: str) -> dict[str, float]:
    """The limits at a commit, or in the working tree; infinite where a figure has none."""
    text = _git(root, "show", f"{commit}:{PAGE}") if commit else (root / PAGE).read_text("utf-8")
    rows = read_bounds(text) if f"\n{HEADING}\n" in text else {}
    return {name: inf if bound.limit is None else bound.limit for name, bound in rows.items()}


def _lines_at(root: Path, commit: str, room: str) -> int:
    """The lines of a room's Python files at a commit; 0 for a figure that is not one of lines."""
    patterns = [f"{folder}/*.py" for folder in ROOMS.get(room, ())]
    if not patterns:
        return 0
    counts = _git(root, "grep", "--count", "", commit, "--", *patterns).splitlines()
    return sum(int(count.rpartition(":")[2]) for count in counts)


def _git(root: Path, *arguments: str) -> str:
    return subprocess.run(
        ("git", *arguments), cwd=root, capture_output=True, text=True, check=True
    ).stdout


def main() -> None:
    """Print the table; exit with code 1 if a limit is exceeded."""
    figures = measure(ROOT)
    bounds = read_bounds((ROOT / PAGE).read_text("utf-8"))
    numbers = [Column(name, justify="right") for name in ("now", "limit", "aim")]
    table = Table("figure", *numbers)
    for name, figure in figures.items():
        bound = bounds.get(name, Bound(None, None))
        table.add_row(name, f"{figure:,}", _shown(bound.limit), _shown(bound.aim))
    print_table(table)
    violations = find_violations(figures, bounds)
    try:
        violations += find_late_raises(ROOT)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = getattr(error, "stderr", None) or error
        print_note(f"The history was not examined for limits that were raised late: {reason}")
    for violation in violations:
        print_note(violation)
    if violations:
        print_note("docs/CONTRIBUTING.md says how a limit is raised.")
        raise SystemExit(1)


def _number(text: str) -> int | None:
    return None if text == "-" else int(text.replace(",", ""))


def _shown(number: int | None) -> str:
    return "-" if number is None else f"{number:,}"


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends it without a traceback
    main()
