"""Formats the sizing as tables for the terminal and `docs/scale.md`, and as JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

from rich.table import Table

from benchmarks.scale.inputs import Inputs, Width
from benchmarks.scale.limits import limits
from benchmarks.scale.plan import Plan
from benchmarks.scale.replacements import scans
from services.cli.output import Json
from shared.errors import Misconfigured

PHOTOS = (10_000, 1_000_000, 100_000_000)
SCALED = (1_000_000, 100_000_000)

Rows = list[list[str]]


@dataclass(frozen=True, slots=True)
class Sheet:
    """A table; `name` marks its place in docs/scale.md."""

    name: str
    title: str
    head: Sequence[str]
    rows: Rows

    def markdown(self) -> str:
        return "\n".join([_line(self.head), "|" + "---|" * len(self.head), *map(_line, self.rows)])

    def table(self) -> Table:
        table = Table(*self.head, title=self.title)
        for row in self.rows:
            table.add_row(*row)
        return table


class Sizing:
    """All results of the sizing."""

    def __init__(self, inputs: Inputs) -> None:
        self.inputs = inputs
        self.widths = Width.both(inputs)
        self.plans = {
            width: [Plan.of(photos, width, inputs) for photos in PHOTOS] for width in self.widths
        }

    def sheets(self) -> list[Sheet]:
        return [
            *(self._plan(width) for width in self.widths),
            self._formulas(),
            self._limits(),
            self._scans(),
            self._inputs(),
        ]

    def put_into(self, page: str) -> str:
        """Return a Markdown page with its tables replaced, each between two comments with its name.

        Raises:
            Misconfigured: `table_missing`, if the page has no place for a table.
        """
        for sheet in self.sheets():
            begin, end = f"<!-- table {sheet.name} -->\n", f"\n<!-- end of {sheet.name} -->"
            before, found, rest = page.partition(begin)
            _, found_end, after = rest.partition(end)
            if not (found and found_end):
                raise Misconfigured(
                    "table_missing",
                    f"The page has no {begin.strip()} with an {end.strip()} after it.",
                )
            page = before + begin + sheet.markdown() + end + after
        return page

    def as_json(self) -> Json:
        return {
            "inputs": [asdict(each) for each in self.inputs],
            "plans": [
                {
                    "photos": plan.photos,
                    "dimensions": width.dimension,
                    "numbers": [asdict(number) for number in plan.numbers],
                }
                for width, plans in self.plans.items()
                for plan in plans
            ],
            "limits": [
                {"dimensions": width.dimension, **asdict(limit)}
                for width in self.widths
                for limit in limits(width, self.inputs)
            ],
            "scans": [asdict(scan) for scan in scans(self.inputs)],
        }

    def _plan(self, width: Width) -> Sheet:
        plans = self.plans[width]
        rows: Rows = []
        for at, number in enumerate(plans[0].numbers):
            values = [plan.numbers[at] for plan in plans]
            rows.append(
                [f"{number.group}: {number.what}", *(amount(n.value, n.unit) for n in values)]
            )
        return Sheet(
            f"plan-{width.dimension}",
            f"{width.dimension:,} dimensions ({width.extractor})",
            ["", *(f"{photos:,} photos" for photos in PHOTOS)],
            rows,
        )

    def _formulas(self) -> Sheet:
        numbers = self.plans[self.widths[0]][0].numbers
        return Sheet(
            "formulas",
            "How each number is derived",
            ["number", "formula"],
            [[f"{number.group}: {number.what}", number.formula] for number in numbers],
        )

    def _limits(self) -> Sheet:
        by_width = [
            {limit.what: limit for limit in limits(width, self.inputs)} for width in self.widths
        ]
        wide = by_width[-1]
        return Sheet(
            "limits",
            "What breaks, and from how many photos on",
            ["what", *(f"{width.dimension:,} dimensions" for width in self.widths), "formula"],
            [
                [what, *(rounded(found[what].photos) for found in by_width), limit.formula]
                for what, limit in wide.items()
            ],
        )

    def _scans(self) -> Sheet:
        rows = []
        for scan in scans(self.inputs):
            shown = [
                f"{amount(scan.memory_bytes * photos, 'B')}, "
                f"{amount(scan.row_seconds * photos, 's')}"
                for photos in SCALED
            ]
            rows.append([scan.name, amount(scan.memory_bytes, "B"), *shown, scan.status, scan.note])
        return Sheet(
            "scans",
            "Ways to scan, 98,304 dimensions",
            ["rows", "memory a row", *(f"{n:,} rows" for n in SCALED), "status", ""],
            rows,
        )

    def _inputs(self) -> Sheet:
        return Sheet(
            "inputs",
            "Inputs",
            ["name", "value", "", "from"],
            [[f"`{i.name}`", _plain(i.value, i.unit), i.kind, i.source] for i in self.inputs],
        )


def amount(value: float, unit: str) -> str:
    """Format with three digits and a suitable unit: 393 kB, 1.97 TB, 2.2 h."""
    if unit == "B":
        return _scaled(value, (("PB", 1e15), ("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)))
    if unit == "s":
        if value < 1:
            return _scaled(value, (("ms", 1e-3), ("us", 1e-6)))
        return _scaled(value, (("h", 3600), ("min", 60), ("s", 1)))
    return f"{rounded(value)} {unit}".strip()


def _scaled(value: float, units: Iterable[tuple[str, float]]) -> str:
    """Scale by the first unit that is not larger than the value, else by the last."""
    *larger, smallest = units
    name, size = next((unit for unit in larger if value >= unit[1]), smallest)
    return f"{rounded(value / size)} {name}"


def rounded(value: float) -> str:
    """Format with three significant digits: 0.0116, 2.31, 45,700,000."""
    if value == 0:
        return "0"
    text = f"{float(f'{value:.3g}'):,.10f}".rstrip("0")
    return text.rstrip(".")


def _plain(value: float, unit: str) -> str:
    text = f"{value:,.6f}".rstrip("0").rstrip(".")
    return f"{text} {unit}".strip()


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
