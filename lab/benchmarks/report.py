"""Benchmark report: measurements with their targets and the load average, and latency percentiles.

The table of a report has these columns: what was measured; the value; its target, if it has one;
whether the target was met; and the load average of the machine (the number of processes that were
running or waiting, over the last minute) when the value was added. On two cores, a load average
well above 2 means that other work slowed the measurement down.

    python -m lab.benchmarks.report FOLDER

prints one Markdown table of the JSON reports in a folder. A measurement without a report has a file
`.err` instead; its last line is shown.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import typer
from rich.progress import Progress

from services.cli.output import Table, print_json, print_table, progress_bar


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured value. `target` is a minimum if `at_least`, else a maximum."""

    what: str
    measured: float
    unit: str = ""
    target: float | None = None
    at_least: bool = False
    load_average: float = field(default_factory=lambda: os.getloadavg()[0])

    @property
    def missed(self) -> bool:
        if self.target is None:
            return False
        return self.measured < self.target if self.at_least else self.measured > self.target

    @property
    def bound(self) -> str:
        if self.target is None:
            return ""
        limit = "at least" if self.at_least else "at most"
        return f"{limit} {_format_number(self.target)} {self.unit}".strip()


@dataclass(slots=True)
class Report:
    """All values of a benchmark, in the order in which they are shown."""

    title: str
    figures: list[Figure] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    """Further values of the JSON output; not shown in the table."""
    tables: list[Table] = field(default_factory=list)
    """Shown before that of the figures."""

    def add(
        self,
        what: str,
        measured: float,
        unit: str = "",
        *,
        at_most: float | None = None,
        at_least: float | None = None,
    ) -> None:
        target = at_most if at_least is None else at_least
        self.figures.append(Figure(what, measured, unit, target, at_least is not None))

    def add_latency(
        self,
        what: str,
        seconds: Sequence[float],
        *,
        p95_at_most_ms: float | None = None,
    ) -> None:
        """Add p50, p95 and the maximum of durations in seconds, as milliseconds."""
        found = LatencySummary.of(seconds)
        self.add(f"{what}, p50", 1000 * found.median, "ms")
        self.add(f"{what}, p95", 1000 * found.p95, "ms", at_most=p95_at_most_ms)
        self.add(f"{what}, worst", 1000 * found.worst, "ms")

    @property
    def missed(self) -> bool:
        """Whether any value misses its target."""
        return any(figure.missed for figure in self.figures)

    def as_json(self) -> dict[str, Any]:
        figures = [
            {**asdict(figure), "target": figure.bound or None, "missed": figure.missed}
            for figure in self.figures
        ]
        return {"title": self.title, "missed": self.missed, "figures": figures, **self.details}

    def table(self) -> Table:
        table = Table("what", "measured", "target", "result", "load", title=self.title)
        for figure in self.figures:
            table.add_row(
                figure.what,
                f"{_format_number(figure.measured)} {figure.unit}".strip(),
                figure.bound,
                "" if figure.target is None else "missed" if figure.missed else "met",
                f"{figure.load_average:.1f}",
                style="red" if figure.missed else None,
            )
        return table


@contextlib.contextmanager
def printed_report(title: str, as_json: bool) -> Iterator[tuple[Report, Progress]]:
    """Yield an empty report and progress bars for a benchmark command, and print the report.

    Raises typer.Exit: with code 1, if a value misses its target.
    """
    report = Report(title)
    with progress_bar() as progress:
        yield report, progress
    if as_json:
        print_json(report.as_json())
    else:
        for table in (*report.tables, report.table()):
            print_table(table)
    if report.missed:
        raise typer.Exit(1)


def parse_integers(text: str) -> list[int]:
    """Parse a comma-separated list of positive integers; returns them sorted and unique.

    Raises typer.BadParameter: the text is no such list.
    """
    try:
        numbers = sorted({int(part) for part in text.split(",")})
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a list of integers such as 1,2,4") from None
    if numbers[0] < 1:
        raise typer.BadParameter("numbers must be at least 1")
    return numbers


def integers_option(help_text: str, *names: str) -> Any:
    """Return a typer option whose value is a comma-separated list of positive integers."""
    return typer.Option(*names, help=help_text, parser=parse_integers, metavar="INTEGERS")


@dataclass(frozen=True, slots=True)
class LatencySummary:
    """Percentiles of call durations, in seconds; other load affects `best` least."""

    best: float
    median: float
    p95: float
    worst: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> LatencySummary:
        """Summarise durations in seconds; ValueError if there are none."""
        if not seconds:
            raise ValueError("nothing was timed")
        ordered = sorted(seconds)
        last = len(ordered) - 1
        p95 = ordered[min(last, int(0.95 * len(ordered)))]
        return cls(ordered[0], median(ordered), p95, ordered[-1])


def _format_number(value: float) -> str:
    if value == int(value) and abs(value) < 1e9:
        return f"{value:,.0f}"
    return f"{value:,.1f}" if abs(value) >= 10 else f"{value:.3g}"


def markdown_lines(folder: Path) -> Iterator[str]:
    """Yield the lines of the table of a folder's reports, in the order of the file names."""
    yield "| measurement | what | value | target | load |"
    yield "|---|---|---|---|---|"
    for file in sorted([*folder.glob("*.json"), *folder.glob("*.err")]):
        if file.suffix == ".err":
            reason = (file.read_text().strip().splitlines() or ["no result"])[-1]
            yield f"| {file.stem} | **not measured**: {reason} | | | |"
            continue
        report = json.loads(file.read_text())
        for figure in report["figures"]:
            target = (figure["target"] or "") + (", missed" if figure["missed"] else "")
            yield (
                f"| {file.stem}: {report['title']} | {figure['what']} "
                f"| {figure['measured']:.4g} {figure['unit']} | {target} "
                f"| {figure['load_average']:.1f} |"
            )


if __name__ == "__main__":
    print("\n".join(markdown_lines(Path(sys.argv[1]))))
