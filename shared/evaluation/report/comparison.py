"""Several descriptors on one page: a table, and what their recall costs.

Which of several descriptors are worth their price.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from shared.datasets.open_dataset import EvaluationSet
from shared.evaluation.bootstrap import PairedDifference
from shared.evaluation.report.charts import STYLE, Axis, Series, line_chart, percent_axis
from shared.evaluation.retrieval_metrics import RetrievalMetrics


def pareto_front(costs: Sequence[float], values: Sequence[float]) -> list[bool]:
    """Whether nothing else is at least as good in both and better in one: cheaper, or worth more.

    One whose price is NaN (not measured) is never on the front.
    """
    points = list(zip(costs, values, strict=True))
    return [
        not math.isnan(price)
        and not any(
            other_price <= price
            and other_worth >= worth
            and (other_price < price or other_worth > worth)
            for other_price, other_worth in points
        )
        for price, worth in points
    ]


@dataclass(frozen=True, slots=True)
class ComparedExtractor:
    name: str
    measured: RetrievalMetrics
    difference: PairedDifference | None
    """of R@1 to the first one's; None for the first"""
    dimension: int
    bytes_a_photo: int
    milliseconds_a_photo: float | None
    fingerprint: str
    device: str

    @property
    def recall_at_1(self) -> float:
        return self.measured.recalls.recall_all[1]

    @property
    def milliseconds(self) -> float:
        """NaN where nothing was measured."""
        return math.nan if self.milliseconds_a_photo is None else self.milliseconds_a_photo

    def against_first(self) -> str:
        """The difference in points, and its interval, in words."""
        if self.difference is None:
            return ""
        said = f"{100 * self.difference.mean:+.1f}"
        if self.difference.low is None or self.difference.high is None:
            return said
        low, high = 100 * self.difference.low, 100 * self.difference.high
        return f"{said} ({low:+.1f} to {high:+.1f})"

    def as_json(self) -> dict[str, Any]:
        figures = self.measured.as_json()
        kept = ("recall", "recall_interval", "recall_findable", "mean_average_precision")
        return {
            "extractor": self.name,
            "fingerprint": self.fingerprint,
            "device": self.device,
            "dimension": self.dimension,
            "bytes_a_photo": self.bytes_a_photo,
            "milliseconds_a_photo": self.milliseconds_a_photo,
            **{name: figures[name] for name in (*kept, "intervals")},
            "against_first": self.difference.as_json() if self.difference else None,
        }


def render_comparison(evaluation_set: EvaluationSet, compared: Sequence[ComparedExtractor]) -> str:
    ks = list(compared[0].measured.recalls.recall_all)
    heads = [
        "",
        *(f"R@{k}" for k in ks),
        "95 % of R@1",
        "ms a photo",
        "bytes a photo",
        "R@1 less the first's",
    ]
    rows = "".join(_table_row(one) for one in compared)
    charts = [
        _cost_chart(
            "What the size buys", "bytes a photo", compared, [c.bytes_a_photo for c in compared]
        ),
        _cost_chart(
            "What the time buys", "ms a photo", compared, [c.milliseconds for c in compared]
        ),
    ]
    drawn = "".join(f"<figure>{one}</figure>" for one in charts if one)
    clusters = compared[0].measured.clusters
    title = f"Descriptors on {evaluation_set.name}"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>"
        f"<h1>{escape(title)}</h1><p>{len(evaluation_set.database)} database photos, "
        f"{len(evaluation_set.queries)} "
        f"queries; right: {escape(evaluation_set.rule)}; protocol "
        f"{escape(evaluation_set.protocol)}; fingerprint "
        f"<code>{evaluation_set.fingerprint}</code>.</p>"
        f"<div class='wide'><table><tr>{''.join(f'<th>{h}</th>' for h in heads)}</tr>{rows}</table>"
        f'</div><p class="note">Intervals: a bootstrap over {clusters.count} {clusters.kind}; the '
        "differences are paired, query by query. Time: network and aggregation, measured when the "
        "rows were made. Size: float32.</p>"
        f'<div class="charts">{drawn}</div></body></html>\n'
    )


def _table_row(one: ComparedExtractor) -> str:
    shown = [f"{100 * share:.1f}" for share in one.measured.recalls.recall_all.values()]
    interval = one.measured.recall_intervals
    shown.append(
        f"{100 * interval[0].low:.1f} to {100 * interval[0].high:.1f}" if interval else "-"
    )
    took = one.milliseconds_a_photo
    shown += ["-" if took is None else f"{took:.1f}", f"{one.bytes_a_photo:,}", one.against_first()]
    cells = "".join(f'<td class="n">{escape(text)}</td>' for text in shown)
    return f"<tr><th>{escape(one.name)}</th>{cells}</tr>"


def _cost_chart(
    title: str, label: str, compared: Sequence[ComparedExtractor], costs: Sequence[float]
) -> str | None:
    """R@1 over a price, both on one chart, the front joined; None where no price is known."""
    worths = [one.recall_at_1 for one in compared]
    known = [price for price in costs if price > 0]  # NaN is not
    if not known:
        return None
    low = 10 ** math.floor(math.log10(min(known)))
    high = 10 ** math.ceil(math.log10(max(known) * 1.0001))
    steps = round(math.log10(high / low))
    x = Axis(label, low, high, [low * 10**step for step in range(steps + 1)], log=True)
    front = pareto_front(costs, worths)
    joined = sorted((p, w) for p, w, on in zip(costs, worths, front, strict=True) if on)
    series = [Series("not beaten in both", joined)]
    series += [
        Series(one.name, [(price, worth)], line=False)
        for one, price, worth in zip(compared, costs, worths, strict=True)
        if price > 0
    ]
    return line_chart(title, x, percent_axis("R@1"), series)
