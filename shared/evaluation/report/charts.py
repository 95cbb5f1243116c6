"""Line charts as SVG.

The curves of a result: recall, precision, distance.

Where queries were taken and where their first match lies: a map in metres, as SVG.

How reports look.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from shared.datasets.open_dataset import DatasetPhoto
from shared.evaluation.results import EvaluationResult
from shared.evaluation.retrieval_metrics import distance_error

WIDTH, HEIGHT = 460, 300
LEFT, RIGHT, TOP, BOTTOM = 54, 14, 14, 44
# Okabe and Ito's colours, which people with any colour vision tell apart.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


@dataclass(frozen=True, slots=True)
class Axis:
    label: str
    low: float
    high: float
    ticks: Sequence[float]
    log: bool = False
    percent: bool = False

    def share(self, value: float) -> float:
        """Where a value lies between the axis' ends, 0 to 1."""
        if self.log:
            low, high, value = math.log(self.low), math.log(self.high), math.log(value)
        else:
            low, high = self.low, self.high
        return min(1.0, max(0.0, (value - low) / (high - low)))

    def text(self, value: float) -> str:
        return f"{100 * value:g} %" if self.percent else f"{value:g}"


@dataclass(frozen=True, slots=True)
class Series:
    label: str
    points: Sequence[tuple[float, float]]
    line: bool = True
    """else points with their labels beside them"""


def percent_axis(label: str) -> Axis:
    """An axis from 0 to 100 %."""
    return Axis(label, 0.0, 1.0, (0, 0.25, 0.5, 0.75, 1.0), percent=True)


def line_chart(title: str, x: Axis, y: Axis, series: Sequence[Series]) -> str:
    """One `<svg>`; values beyond an axis' ends are drawn at its end."""
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">',
        f"<title>{escape(title)}</title>",
    ]
    parts += _grid(x, y)
    for number, one in enumerate(series):
        colour = COLOURS[number % len(COLOURS)]
        places = [(_x(x, a), _y(y, b)) for a, b in one.points]
        if one.line:
            path = " ".join(f"{a:.1f},{b:.1f}" for a, b in places)
            parts.append(
                f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>'
            )
            parts.append(
                f'<text x="{WIDTH - RIGHT - 6}" y="{HEIGHT - BOTTOM - 10 - 15 * number}" '
                f'text-anchor="end" fill="{colour}">{escape(one.label)}</text>'
            )
        for a, b in places if not one.line or len(places) <= 20 else ():
            parts.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{colour}"/>')
        if not one.line:
            for a, b in places:
                end = a > WIDTH * 0.6
                parts.append(
                    f'<text x="{a + (-7 if end else 7):.1f}" y="{b - 6:.1f}" fill="{colour}" '
                    f'text-anchor="{"end" if end else "start"}">{escape(one.label)}</text>'
                )
    parts.append("</svg>")
    return "".join(parts)


def _grid(x: Axis, y: Axis) -> list[str]:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = [
        f'<rect x="{LEFT}" y="{TOP}" width="{right - LEFT}" height="{bottom - TOP}" class="p"/>'
    ]
    for tick in x.ticks:
        at = _x(x, tick)
        parts.append(f'<line x1="{at:.1f}" y1="{TOP}" x2="{at:.1f}" y2="{bottom}" class="g"/>')
        parts.append(
            f'<text x="{at:.1f}" y="{bottom + 15}" text-anchor="middle">{x.text(tick)}</text>'
        )
    for tick in y.ticks:
        at = _y(y, tick)
        parts.append(f'<line x1="{LEFT}" y1="{at:.1f}" x2="{right}" y2="{at:.1f}" class="g"/>')
        parts.append(
            f'<text x="{LEFT - 5}" y="{at + 4:.1f}" text-anchor="end">{y.text(tick)}</text>'
        )
    middle = (LEFT + right) / 2
    parts.append(
        f'<text x="{middle}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x.label)}</text>'
    )
    parts.append(
        f'<text transform="translate(12 {(TOP + bottom) / 2}) rotate(-90)" '
        f'text-anchor="middle">{escape(y.label)}</text>'
    )
    return parts


def _x(axis: Axis, value: float) -> float:
    return LEFT + axis.share(value) * (WIDTH - RIGHT - LEFT)


def _y(axis: Axis, value: float) -> float:
    return HEIGHT - BOTTOM - axis.share(value) * (HEIGHT - BOTTOM - TOP)


def recall_chart(result: EvaluationResult) -> str:
    curve = result.measured.recall_curve
    ticks = [k for k in (1, 5, 10, 20, 50, 100) if k <= len(curve)]
    x = Axis("k: database photos looked at", 1, max(2, len(curve)), ticks)
    points = list(enumerate(curve, start=1))
    series = [Series("of all queries", points)]
    total = result.measured.recalls.queries
    findable = total - result.measured.recalls.without_positive
    if 0 < findable < total:
        raised = [(k, share * total / findable) for k, share in points]
        series.append(Series("of those with a positive", raised))
    return line_chart("Recall at k", x, percent_axis("recall at k"), series)


def precision_chart(result: EvaluationResult) -> str | None:
    curve = result.measured.curve
    if curve is None:
        return None
    points = list(zip(curve.recall.tolist(), curve.precision.tolist(), strict=True))
    shown = points[:: max(1, len(points) // 400)] + points[-1:]
    label = f"area {curve.area:.3f}"
    return line_chart(
        "Precision and recall of the first match",
        percent_axis("recall: answered rightly"),
        percent_axis("precision: right of the answers"),
        [Series(label, shown)],
    )


def distance_chart(result: EvaluationResult) -> str | None:
    metres = result.measured.metres
    found = None if metres is None else distance_error(metres[:, 0])
    if found is None:
        return None
    points = [(entry["metres"], entry["share"]) for entry in found["within"]]
    x = Axis("x in metres", 1, 1000, (1, 5, 25, 100, 1000), log=True)
    label = f"median {found['median_m']:.1f} m"
    return line_chart(
        "How far the first match lies", x, percent_axis("within x metres"), [Series(label, points)]
    )


MAP_PIXELS = 620  # pixels
MAP_MARGIN_PIXELS = 12
MAX_DATABASE_POINTS = 4000
MAX_QUERY_POINTS = 2000
MAX_SCALE_BAR_SHARE = 0.25  # of the width that the scale's bar takes at most


def positions_chart(result: EvaluationResult) -> tuple[str, str] | None:
    """The `<svg>` and what it leaves out; None where there are no positions to draw."""
    zone = _most_common_zone(result.asked.queries)
    database = [_point(shot, zone) for shot in result.asked.database]
    queries = [_point(shot, zone) for shot in result.asked.queries]
    drawn = [q for q, point in enumerate(queries) if point is not None]
    seen = [point for point in (*database, *queries) if point is not None]
    if not drawn or not any(point is not None for point in database):
        return None
    east, north = np.array(seen).T
    low, high = np.array([east.min(), north.min()]), np.array([east.max(), north.max()])
    span = float(max(*(high - low), 1.0))
    scale = (MAP_PIXELS - 2 * MAP_MARGIN_PIXELS) / span
    height = int((high[1] - low[1]) * scale) + 2 * MAP_MARGIN_PIXELS + 24

    def at(point: tuple[float, float]) -> tuple[float, float]:
        x = MAP_MARGIN_PIXELS + (point[0] - low[0]) * scale
        return x, height - 24 - MAP_MARGIN_PIXELS - (point[1] - low[1]) * scale

    label = "Map of queries and their first matches"
    parts = [f'<svg viewBox="0 0 {MAP_PIXELS} {height}" role="img" class="m" aria-label="{label}">']
    there = [point for point in database if point is not None]
    parts += [
        '<circle cx="{:.1f}" cy="{:.1f}" r="1.5" class="d"/>'.format(*at(point))
        for point in there[:: max(1, -(-len(there) // MAX_DATABASE_POINTS))]
    ]
    shown = drawn[:: max(1, -(-len(drawn) // MAX_QUERY_POINTS))]
    for query in shown:
        asked = queries[query]
        assert asked is not None
        right = bool(result.measured.hits[query, 0])
        x, y = at(asked)
        match = database[result.ranked.indices[query, 0]]
        if match is not None:
            to_x, to_y = at(match)
            parts.append(
                f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" '
                f'class="{"r" if right else "w"}"/>'
            )
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" class="{"r" if right else "w"}"/>')
    parts += [*_scale_bar(span, scale, height), "</svg>"]
    said = f"{len(shown)} of {len(queries)} queries, zone {zone or 'not said'}"
    return "".join(parts), said


def _most_common_zone(shots: tuple[DatasetPhoto, ...]) -> str | None:
    zones = Counter(shot.zone for shot in shots if shot.easting is not None)
    return zones.most_common(1)[0][0] if zones else None


def _point(shot: DatasetPhoto, zone: str | None) -> tuple[float, float] | None:
    if shot.easting is None or shot.northing is None or shot.zone != zone:
        return None
    return shot.easting, shot.northing


def _scale_bar(span: float, scale: float, height: int) -> list[str]:
    """A bar of 1, 2 or 5 times a power of ten metres."""
    least = span * MAX_SCALE_BAR_SHARE / 2
    power = 10.0 ** np.floor(np.log10(least))
    metres = next(m for m in (power, 2 * power, 5 * power, 10 * power) if m >= least)
    y = height - 12
    return [
        (
            f'<line x1="{MAP_MARGIN_PIXELS}" y1="{y}" '
            f'x2="{MAP_MARGIN_PIXELS + metres * scale:.1f}" y2="{y}" class="b"/>'
        ),
        f'<text x="{MAP_MARGIN_PIXELS + metres * scale + 6:.1f}" y="{y + 4}">{metres:g} m</text>',
    ]


STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#1a1a1a;background:#fff;max-width:1180px;
margin:0 auto;padding:1rem 1.5rem}
h1{font-size:1.6rem}h2{margin-top:2.4rem;border-top:2px solid #ddd;padding-top:1rem}
table{border-collapse:collapse;margin:.6rem 0}td,th{padding:.25rem .7rem;text-align:left;
border-bottom:1px solid #e5e5e5;vertical-align:top}td.n{text-align:right;
font-variant-numeric:tabular-nums}.charts{display:flex;flex-wrap:wrap;gap:1rem}
.charts figure{margin:0;flex:1 1 420px;max-width:560px}svg{width:100%;height:auto;
font:12px system-ui,sans-serif}svg .p{fill:none;stroke:#888}svg .g{stroke:#e5e5e5}
svg.m{max-width:760px;border:1px solid #ddd}.m .d{fill:#c4c4c4}.m circle.r{fill:#009e73}
.m circle.w{fill:#d55e00}.m line.r{stroke:#009e73}.m line.w{stroke:#d55e00;stroke-opacity:.55}
.m .b{stroke:#1a1a1a;stroke-width:2}.wide{overflow-x:auto}.grid td{padding:.3rem;border:0}
.grid img,.grid .none{width:180px;height:135px;object-fit:cover;display:block;border:5px solid}
.grid .none{background:#f2f2f2;color:#666;display:grid;place-items:center}
.grid .query{border-color:#0057d9}.grid .right{border-color:#128a3a}
.grid .wrong{border-color:#d32020}
.grid .missed{border-style:dashed}.grid small{display:block;max-width:190px;overflow-wrap:anywhere}
code{overflow-wrap:anywhere}figcaption,.note{color:#555;font-size:.9rem}
"""
