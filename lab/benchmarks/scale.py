"""Capacity planning: machines, storage and cost of a map, by number of photos and descriptor width.

    placewise bench scale [--set NAME=VALUE] [--measure] [--markdown docs/scale.md]

The page docs/scale.md is the model: its tables `inputs`, `formulas` and `limits` are read and
evaluated like the cells of a spreadsheet, and the numbers are written into its tables `plan-*` and
`limits`. Columns are numbers of photos; amounts have three significant digits. Bytes are decimal.
"""

from __future__ import annotations

import hashlib
import math
import timeit
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lab.benchmarks.search.growth import make_scan
from services.cli.output import Table
from services.search.worker import FOLLOW_SECONDS
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.search_api.client import MAX_CONCURRENT_CALLS

PAGE = Path(__file__).parents[2] / "docs" / "scale.md"
PHOTOS = (10_000, 1_000_000, 100_000_000)
WIDTHS = (14_336, 98_304)
WIDTH_INPUTS = ("gpu_photos_per_second", "pipeline_cpu_seconds")
MEASURED_CODES = 1_000_000  # 512 MB: larger than any CPU cache
FUNCTIONS = {"__builtins__": {}, "min": min, "max": max, "ceil": math.ceil}

Rows = list[list[str]]


class Sizing:
    """The page's inputs and formulas, with the values that replace inputs."""

    def __init__(self, replaced: Mapping[str, float], page: str | None = None) -> None:
        """Read the page, by default docs/scale.md.

        Raises:
            Misconfigured: `unknown_input`, for a name that is not an input or a value that is not
                above 0; `table_missing`, if the page lacks a table.
        """
        self._page = PAGE.read_text(encoding="utf-8") if page is None else page
        self.inputs = {
            name.strip("`"): float(value.split()[0].replace(",", ""))
            for name, value, _ in self._read("inputs")[1:]
        }
        for name, value in replaced.items():
            if name not in self.inputs:
                raise Misconfigured(
                    "unknown_input", f"{name!r} is not one of {', '.join(sorted(self.inputs))}."
                )
            if not (math.isfinite(value) and value > 0):
                raise Misconfigured("unknown_input", f"{name} must be above 0, not {value:g}.")
            self.inputs[name] = value
        self._formulas = [[cell.strip("`") for cell in row] for row in self._read("formulas")[1:]]
        self._limits = {row[0]: row[-1].strip("`") for row in self._read("limits")[1:]}

    def evaluate(self, photos: int, dimensions: int) -> tuple[dict[str, float], dict[str, float]]:
        """Return the plan by name, and by description the numbers of photos of the limits."""
        values: dict[str, Any] = {**self.inputs, "photos": photos, "dimensions": dimensions}
        values["slot_rows"] = Settings.model_fields["slot_rows"].default
        values["search_follow_seconds"] = FOLLOW_SECONDS
        values["max_concurrent_calls"] = MAX_CONCURRENT_CALLS
        for name in WIDTH_INPUTS:
            values[name] = self.inputs[f"{name}_{dimensions}"]
        plan = {}
        for name, _, formula in self._formulas:
            # The formulas are those of our own page.
            plan[name] = values[name] = eval(formula, FUNCTIONS, values)  # noqa: S307
        return plan, {what: eval(f, FUNCTIONS, values) for what, f in self._limits.items()}  # noqa: S307

    def tables(self) -> dict[str, Rows]:
        """Return the computed tables by their name on the page; the first row is the head."""
        found = {}
        for width in WIDTHS:
            plans = [self.evaluate(photos, width)[0] for photos in PHOTOS]
            found[f"plan-{width}"] = [
                ["number", *(f"{photos:,} photos" for photos in PHOTOS)],
                *(
                    [f"`{name}`", *(format_amount(plan[name], unit) for plan in plans)]
                    for name, unit, _ in self._formulas
                ),
            ]
        narrow, wide = (self.evaluate(PHOTOS[-1], width)[1] for width in WIDTHS)
        found["limits"] = [
            ["what", *(f"{width:,} dimensions" for width in WIDTHS), "formula"],
            *(
                [what, format_amount(narrow[what]), format_amount(wide[what]), f"`{formula}`"]
                for what, formula in sorted(self._limits.items(), key=lambda item: wide[item[0]])
            ),
        ]
        return found

    def updated_page(self) -> str:
        """Return the page with its computed tables replaced."""
        page = self._page
        for name, rows in self.tables().items():
            before, _, after = self._split(page, name)
            lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
            page = before + "\n".join(f"| {' | '.join(row)} |" for row in lines) + after
        return page

    def terminal_tables(self) -> list[Table]:
        """Return the computed tables without the page's backticks."""
        found = []
        for name, (head, *rows) in self.tables().items():
            found.append(Table(*head, title=name))
            for row in rows:
                found[-1].add_row(*(cell.replace("`", "") for cell in row))
        return found

    def as_json(self) -> dict[str, Any]:
        """Return inputs, and for each size the plan and the limits, without units."""
        plans = []
        for width in WIDTHS:
            for photos in PHOTOS:
                numbers, limits = self.evaluate(photos, width)
                plans.append(
                    {"photos": photos, "dimensions": width, "numbers": numbers, "limits": limits}
                )
        return {"inputs": self.inputs, "plans": plans}

    def _read(self, name: str) -> Rows:
        lines = self._split(self._page, name)[1].splitlines()
        rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
        return [rows[0], *rows[2:]]

    @staticmethod
    def _split(page: str, name: str) -> tuple[str, str, str]:
        """Return the text before, in and after a table, which stands between two comments."""
        begin, end = f"<!-- table {name} -->\n", f"\n<!-- end of {name} -->"
        before, found, rest = page.partition(begin)
        table, found_end, after = rest.partition(end)
        if not (found and found_end):
            raise Misconfigured(
                "table_missing", f"The page lacks {begin.strip()} or {end.strip()} after it."
            )
        return before + begin, table, end + after


def parse_assignments(texts: Sequence[str]) -> dict[str, float]:
    """Parse `NAME=VALUE` texts.

    Raises:
        Misconfigured: `unknown_input`, if one has another form.
    """
    try:
        return {name.strip(): float(value) for name, value in (t.split("=") for t in texts)}
    except ValueError:
        raise Misconfigured(
            "unknown_input", f"{', '.join(texts)}: write NAME=VALUE, such as price_gpu_hour=2."
        ) from None


def measure_inputs() -> dict[str, float]:
    """Measure the scan of sign codes, and SHA-256; needs 1 GB of memory, takes seconds."""
    codes, scan = make_scan(MEASURED_CODES)
    scan_seconds = min(timeit.repeat(scan, number=1, repeat=7))
    hash_seconds = min(timeit.repeat(lambda: hashlib.sha256(codes.data), number=1, repeat=3))
    return {
        "scan_us": 1e6 * scan_seconds / MEASURED_CODES,
        "hash_bytes_per_second": codes.nbytes / hash_seconds,
    }


def format_amount(value: float, unit: str = "") -> str:
    """Format with three significant digits and a suitable unit: 393 kB, 1.97 TB, 2.22 h."""
    scales = {
        "B": {"PB": 1e15, "TB": 1e12, "GB": 1e9, "MB": 1e6, "kB": 1e3, "B": 1},
        "s": {"h": 3600, "min": 60, "s": 1, "ms": 1e-3, "us": 1e-6},
    }.get(unit, {unit: 1})
    name, size = next(((n, s) for n, s in scales.items() if value >= s), (unit, 1))
    number = f"{float(f'{value / size:.3g}'):,.6f}".rstrip("0").rstrip(".")
    return f"{number} {name}".strip()
