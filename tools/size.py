"""Prints the size of the code beside its limits, and fails where a limit is exceeded: `make size`.

The limits and aims are in a table of `docs/architecture.md`. `python -m tools.size --lower` lowers
the limits there to the present figures; raising one is a decision, and is edited by hand.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.table import Column

from services.cli.main import COMMANDS
from services.cli.output import Table, print_note, print_table
from shared.config.settings import Settings

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
HEADING = "## Size"
ROOMS = {
    "service": ("placewise", "services", "shared", "tools"),
    "lab": ("lab",),
    "tests": ("tests",),
}
MIGRATIONS = "shared/catalog/migrations/versions"
ROW = re.compile(r"^\| ([a-z ]+) \| ([\d,]+|-) \| ([\d,]+|-) \|$", re.MULTILINE)


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
        raise SystemExit(f"{PAGE.name} has no heading `{HEADING}`.")
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


def lower_limits(page: str, figures: Mapping[str, int]) -> str:
    """Return the page with each limit above its figure lowered to the figure."""

    def lowered(row: re.Match[str]) -> str:
        name, limit, aim = row.groups()
        number = _number(limit)
        if number is None or figures.get(name, number) >= number:
            return row[0]
        return f"| {name} | {figures[name]:,} | {aim} |"

    before, heading, section = page.partition(f"\n{HEADING}\n")
    section, end, after = section.partition("\n## ")
    return before + heading + ROW.sub(lowered, section) + end + after


def main(arguments: list[str]) -> None:
    """Print the table; exit with code 1 if a limit is exceeded."""
    figures = measure(ROOT)
    page = PAGE.read_text("utf-8")
    if arguments == ["--lower"]:
        page = lower_limits(page, figures)
        PAGE.write_text(page, "utf-8")
    elif arguments:
        raise SystemExit("usage: python -m tools.size [--lower]")
    bounds = read_bounds(page)
    numbers = [Column(name, justify="right") for name in ("now", "limit", "aim")]
    table = Table("figure", *numbers)
    for name, figure in figures.items():
        bound = bounds.get(name, Bound(None, None))
        table.add_row(name, f"{figure:,}", _shown(bound.limit), _shown(bound.aim))
    print_table(table)
    violations = find_violations(figures, bounds)
    for violation in violations:
        print_note(violation)
    if violations:
        print_note(f"Raise a limit in docs/{PAGE.name} only with a decision record.")
        raise SystemExit(1)


def _number(text: str) -> int | None:
    return None if text == "-" else int(text.replace(",", ""))


def _shown(number: int | None) -> str:
    return "-" if number is None else f"{number:,}"


if __name__ == "__main__":
    main(sys.argv[1:])
