"""SVG charts of reports: recall, precision-recall and distance curves, map, and the stylesheet.

The charts are written as SVG text, so that a report needs no plotting library and no script.
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
# The palette of Okabe and Ito, which is distinguishable with any colour vision.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


@dataclass(frozen=True, slots=True)
class Axis:
    """Axis of a line chart: range, ticks and number format."""

    label: str
    low: float
    high: float
    ticks: Sequence[float]
    log: bool = False
    percent: bool = False

    def fraction(self, value: float) -> float:
        """Return a value's position on the axis, clipped to 0 ... 1."""
        if self.log:
            low, high, value = math.log(self.low), math.log(self.high), math.log(value)
        else:
            low, high = self.low, self.high
        return min(1.0, max(0.0, (value - low) / (high - low)))

    def text(self, value: float) -> str:
        return f"{100 * value:g} %" if self.percent else f"{value:g}"


@dataclass(frozen=True, slots=True)
class Series:
    """Labelled points of a line chart."""

    label: str
    points: Sequence[tuple[float, float]]
    line: bool = True
    """draw a line; if false, points with the label next to them"""


def percent_axis(label: str) -> Axis:
    """Create an axis from 0 to 100 %."""
    return Axis(label, 0.0, 1.0, (0, 0.25, 0.5, 0.75, 1.0), percent=True)


def line_chart(title: str, x: Axis, y: Axis, series: Sequence[Series]) -> str:
    """Render a line chart as `<svg>`; values outside an axis are clipped to it."""
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">',
        f"<title>{escape(title)}</title>",
    ]
    parts += _grid(x, y)
    for number, each in enumerate(series):
        colour = COLOURS[number % len(COLOURS)]
        points = [(_x(x, a), _y(y, b)) for a, b in each.points]
        if each.line:
            path = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
            parts.append(
                f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>'
            )
            parts.append(
                f'<text x="{WIDTH - RIGHT - 6}" y="{HEIGHT - BOTTOM - 10 - 15 * number}" '
                f'text-anchor="end" fill="{colour}">{escape(each.label)}</text>'
            )
        for a, b in points if not each.line or len(points) <= 20 else ():
            parts.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{colour}"/>')
        if not each.line:
            for a, b in points:
                is_right = a > WIDTH * 0.6
                parts.append(
                    f'<text x="{a + (-7 if is_right else 7):.1f}" y="{b - 6:.1f}" fill="{colour}" '
                    f'text-anchor="{"end" if is_right else "start"}">{escape(each.label)}</text>'
                )
    parts.append("</svg>")
    return "".join(parts)


def _grid(x: Axis, y: Axis) -> list[str]:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = [
        f'<rect x="{LEFT}" y="{TOP}" width="{right - LEFT}" height="{bottom - TOP}" class="p"/>'
    ]
    for tick in x.ticks:
        tick_x = _x(x, tick)
        parts.append(
            f'<line x1="{tick_x:.1f}" y1="{TOP}" x2="{tick_x:.1f}" y2="{bottom}" class="g"/>'
        )
        parts.append(
            f'<text x="{tick_x:.1f}" y="{bottom + 15}" text-anchor="middle">{x.text(tick)}</text>'
        )
    for tick in y.ticks:
        tick_y = _y(y, tick)
        parts.append(
            f'<line x1="{LEFT}" y1="{tick_y:.1f}" x2="{right}" y2="{tick_y:.1f}" class="g"/>'
        )
        parts.append(
            f'<text x="{LEFT - 5}" y="{tick_y + 4:.1f}" text-anchor="end">{y.text(tick)}</text>'
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
    return LEFT + axis.fraction(value) * (WIDTH - RIGHT - LEFT)


def _y(axis: Axis, value: float) -> float:
    return HEIGHT - BOTTOM - axis.fraction(value) * (HEIGHT - BOTTOM - TOP)


def recall_chart(result: EvaluationResult) -> str:
    """Render recall@k over k."""
    curve = result.measured.recall_curve
    ticks = [k for k in (1, 5, 10, 20, 50, 100) if k <= len(curve)]
    x = Axis("k: number of retrieved photos", 1, max(2, len(curve)), ticks)
    points = list(enumerate(curve, start=1))
    series = [Series("all queries", points)]
    total = result.measured.recalls.queries
    findable = total - result.measured.recalls.without_positive
    if 0 < findable < total:
        findable_points = [(k, recall * total / findable) for k, recall in points]
        series.append(Series("queries with a positive", findable_points))
    return line_chart("Recall@k", x, percent_axis("recall@k"), series)


def precision_chart(result: EvaluationResult) -> str | None:
    """Render the precision-recall curve; None without scores."""
    curve = result.measured.curve
    if curve is None:
        return None
    points = list(zip(curve.recall.tolist(), curve.precision.tolist(), strict=True))
    shown = points[:: max(1, len(points) // 400)] + points[-1:]
    label = f"area {curve.area:.3f}"
    return line_chart(
        "Precision and recall of the first match",
        percent_axis("recall"),
        percent_axis("precision"),
        [Series(label, shown)],
    )


def distance_chart(result: EvaluationResult) -> str | None:
    """Render the cumulative distance error of first matches; None without positions."""
    metres = result.measured.metres
    error = None if metres is None else distance_error(metres[:, 0])
    if error is None:
        return None
    points = [(entry["metres"], entry["share"]) for entry in error["within"]]
    x = Axis("x in metres", 1, 1000, (1, 5, 25, 100, 1000), log=True)
    label = f"median {error['median_m']:.1f} m"
    return line_chart(
        "Distance of the first match",
        x,
        percent_axis("queries within x metres"),
        [Series(label, points)],
    )


MAP_PIXELS = 620  # width
MAP_MARGIN_PIXELS = 12
MAX_DATABASE_POINTS = 4000
MAX_QUERY_POINTS = 2000
MAX_SCALE_BAR_SHARE = 0.25  # share of the width


def positions_chart(result: EvaluationResult) -> tuple[str, str] | None:
    """Render a map of the queries and their first matches, in UTM metres.

    Returns:
        The `<svg>` and a caption that says how many queries are shown; None without positions.
    """
    zone = _most_common_zone(result.evaluation_set.queries)
    database = [_point(photo, zone) for photo in result.evaluation_set.database]
    queries = [_point(photo, zone) for photo in result.evaluation_set.queries]
    drawable = [q for q, point in enumerate(queries) if point is not None]
    known = [point for point in (*database, *queries) if point is not None]
    if not drawable or not any(point is not None for point in database):
        return None
    east, north = np.array(known).T
    low, high = np.array([east.min(), north.min()]), np.array([east.max(), north.max()])
    span = float(max(*(high - low), 1.0))
    scale = (MAP_PIXELS - 2 * MAP_MARGIN_PIXELS) / span
    height = int((high[1] - low[1]) * scale) + 2 * MAP_MARGIN_PIXELS + 24

    def to_pixels(point: tuple[float, float]) -> tuple[float, float]:
        x = MAP_MARGIN_PIXELS + (point[0] - low[0]) * scale
        return x, height - 24 - MAP_MARGIN_PIXELS - (point[1] - low[1]) * scale

    label = "Map of queries and their first matches"
    parts = [f'<svg viewBox="0 0 {MAP_PIXELS} {height}" role="img" class="m" aria-label="{label}">']
    database_points = [point for point in database if point is not None]
    parts += [
        '<circle cx="{:.1f}" cy="{:.1f}" r="1.5" class="d"/>'.format(*to_pixels(point))
        for point in database_points[:: max(1, -(-len(database_points) // MAX_DATABASE_POINTS))]
    ]
    shown = drawable[:: max(1, -(-len(drawable) // MAX_QUERY_POINTS))]
    for query in shown:
        point = queries[query]
        assert point is not None
        css_class = "r" if result.measured.hits[query, 0] else "w"
        x, y = to_pixels(point)
        match = database[result.ranked.indices[query, 0]]
        if match is not None:
            match_x, match_y = to_pixels(match)
            parts.append(
                f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{match_x:.1f}" y2="{match_y:.1f}" '
                f'class="{css_class}"/>'
            )
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" class="{css_class}"/>')
    parts += [*_scale_bar(span, scale, height), "</svg>"]
    caption = f"{len(shown)} of {len(queries)} queries, UTM zone {zone or 'unknown'}"
    return "".join(parts), caption


def _most_common_zone(photos: tuple[DatasetPhoto, ...]) -> str | None:
    zones = Counter(photo.zone for photo in photos if photo.easting is not None)
    return zones.most_common(1)[0][0] if zones else None


def _point(photo: DatasetPhoto, zone: str | None) -> tuple[float, float] | None:
    if photo.easting is None or photo.northing is None or photo.zone != zone:
        return None
    return photo.easting, photo.northing


def _scale_bar(span: float, scale: float, height: int) -> list[str]:
    """Render a scale bar of 1, 2 or 5 times a power of ten metres."""
    min_metres = span * MAX_SCALE_BAR_SHARE / 2
    power = 10.0 ** np.floor(np.log10(min_metres))
    metres = next(m for m in (power, 2 * power, 5 * power, 10 * power) if m >= min_metres)
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
