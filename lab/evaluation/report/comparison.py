"""HTML comparison of several descriptors: table of recalls, Pareto charts of recall and cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab.datasets.dataset import EvaluationSet
from lab.evaluation.paired_runs import PairedDifference
from lab.evaluation.report.charts import GREY, Chart, percent_chart, render_chart
from lab.evaluation.report.page import render_page
from lab.evaluation.report.tables import write_figures, write_tables
from lab.evaluation.retrieval_metrics import RetrievalMetrics


def pareto_front(costs: Sequence[float], values: Sequence[float]) -> list[bool]:
    """Return whether each point is Pareto-optimal: no other is as cheap and as good, and better.

    A point whose cost is NaN (not measured) is never on the front.
    """
    points = list(zip(costs, values, strict=True))
    return [
        not math.isnan(cost)
        and not any(
            other_cost <= cost
            and other_value >= value
            and (other_cost < cost or other_value > value)
            for other_cost, other_value in points
        )
        for cost, value in points
    ]


@dataclass(frozen=True, slots=True)
class ComparedExtractor:
    """Metrics and costs of one extractor of a comparison."""

    name: str
    measured: RetrievalMetrics
    difference: PairedDifference | None
    """R@1 of this extractor minus R@1 of the first; None for the first"""
    dimension: int
    bytes_a_photo: int
    milliseconds_a_photo: float | None
    """None if not measured"""
    fingerprint: str
    device: str

    @property
    def recall_at_1(self) -> float:
        return self.measured.recalls.recall_all[1]

    @property
    def milliseconds(self) -> float:
        """Time per photo; NaN if not measured."""
        return math.nan if self.milliseconds_a_photo is None else self.milliseconds_a_photo

    def against_first(self) -> str:
        """Format the difference from the first extractor in percentage points, with interval."""
        if self.difference is None:
            return ""
        mean = f"{100 * self.difference.mean:+.1f}"
        interval = self.difference.interval_in_points()
        return mean if interval is None else f"{mean} ({interval})"

    def table_cells(self) -> list[str]:
        """Format recalls, interval of R@1, time, size and difference for a table."""
        interval = self.measured.recall_intervals
        milliseconds = self.milliseconds_a_photo
        return [
            *(f"{100 * recall:.1f}" for recall in self.measured.recalls.recall_all.values()),
            interval[0].as_percent() if interval else "-",
            "-" if milliseconds is None else f"{milliseconds:.1f}",
            f"{self.bytes_a_photo:,}",
            self.against_first(),
        ]

    def as_json(self) -> dict[str, Any]:
        metrics = self.measured.as_json()
        names = ("recall", "recall_interval", "recall_findable", "mean_average_precision")
        return {
            "extractor": self.name,
            "fingerprint": self.fingerprint,
            "device": self.device,
            "dimension": self.dimension,
            "bytes_a_photo": self.bytes_a_photo,
            "milliseconds_a_photo": self.milliseconds_a_photo,
            **{name: metrics[name] for name in (*names, "intervals")},
            "against_first": self.difference.as_json() if self.difference else None,
        }


def write_comparison(
    out: Path, evaluation_set: EvaluationSet, compared: Sequence[ComparedExtractor]
) -> None:
    """Write the HTML page that compares extractors on one evaluation set, tables and figures."""
    sizes = [each.bytes_a_photo for each in compared]
    times = [each.milliseconds for each in compared]
    charts = (
        _cost_chart("Recall and size", "bytes per photo", compared, sizes),
        _cost_chart("Recall and time", "CPU ms per photo", compared, times),
    )
    write_tables(out, [(each.name, each.measured) for each in compared])
    write_figures(out, evaluation_set.name, charts)
    page = render_page(
        "comparison.html",
        title=f"Descriptors on {evaluation_set.name}",
        data_set=evaluation_set,
        compared=compared,
        clusters=compared[0].measured.clusters,
        charts=charts,
    )
    (out / "report.html").write_text(page, encoding="utf-8")


def _cost_chart(
    title: str, label: str, compared: Sequence[ComparedExtractor], costs: Sequence[float]
) -> Chart | None:
    """Render R@1 over a cost, with the Pareto front as a line; None if no cost is known."""
    recalls = [each.recall_at_1 for each in compared]
    known = [cost for cost in costs if cost > 0]  # excludes NaN
    if not known:
        return None
    decades = range(
        math.floor(math.log10(min(known))), math.ceil(math.log10(max(known) * 1.0001)) + 1
    )
    figure, axes = percent_chart(label, "R@1", x_ticks=[10.0**n for n in decades], log=True)
    is_optimal = pareto_front(costs, recalls)
    front = sorted((c, r) for c, r, on in zip(costs, recalls, is_optimal, strict=True) if on)
    axes.plot(*zip(*front, strict=True), ".-", color=GREY, label="Pareto front")
    for each, cost, recall in zip(compared, costs, recalls, strict=True):
        if cost > 0:
            axes.plot(cost, recall, "o", label=each.name)
    axes.legend(fontsize="small")
    return render_chart(figure, title)
