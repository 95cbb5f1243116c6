"""Benchmark report: measured values, their bounds, and latency percentiles."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import median
from typing import Any

from rich.table import Table


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured value. `limit` is a minimum if `at_least`, else a maximum."""

    what: str
    measured: float
    unit: str = ""
    limit: float | None = None
    at_least: bool = False

    @property
    def missed(self) -> bool:
        if self.limit is None:
            return False
        return self.measured < self.limit if self.at_least else self.measured > self.limit

    @property
    def bound(self) -> str:
        if self.limit is None:
            return ""
        return (
            f"at {'least' if self.at_least else 'most'} {_format_number(self.limit)} "
            f"{self.unit}".strip()
        )


@dataclass(slots=True)
class Report:
    """All values of a benchmark, in the order in which they are shown."""

    title: str
    figures: list[Figure] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    """What else a program may want to read; not shown in the table."""
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
        limit = at_most if at_least is None else at_least
        self.figures.append(Figure(what, measured, unit, limit, at_least is not None))

    @property
    def missed(self) -> bool:
        """Whether any value violates its bound."""
        return any(figure.missed for figure in self.figures)

    def as_json(self) -> dict[str, Any]:
        return {
            "title": self.title,
            "missed": self.missed,
            "figures": [
                {
                    "what": figure.what,
                    "measured": figure.measured,
                    "unit": figure.unit,
                    "limit": figure.bound or None,
                    "missed": figure.missed,
                }
                for figure in self.figures
            ],
            **self.details,
        }

    def table(self) -> Table:
        table = Table("what", "measured", "limit", "", title=self.title)
        for figure in self.figures:
            verdict = "" if figure.limit is None else "missed" if figure.missed else "met"
            measured = f"{_format_number(figure.measured)} {figure.unit}".strip()
            table.add_row(
                figure.what, measured, figure.bound, verdict, style="red" if figure.missed else None
            )
        return table


@dataclass(frozen=True, slots=True)
class LatencySummary:
    """Percentiles of call durations, in seconds."""

    median: float
    p95: float
    worst: float

    @classmethod
    def of(cls, seconds: list[float]) -> LatencySummary:
        """Summarise durations in seconds; ValueError if there are none."""
        if not seconds:
            raise ValueError("nothing was timed")
        ordered = sorted(seconds)
        last = len(ordered) - 1
        return cls(median(ordered), ordered[min(last, int(0.95 * len(ordered)))], ordered[-1])


def _format_number(value: float) -> str:
    if value == int(value) and abs(value) < 1e9:
        return f"{value:,.0f}"
    return f"{value:,.1f}" if abs(value) >= 10 else f"{value:.3g}"
