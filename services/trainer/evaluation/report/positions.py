"""Where queries were taken and where their first match lies: a map in metres, as SVG."""

from __future__ import annotations

from collections import Counter

import numpy as np

from services.trainer.evaluation.result import EvaluationResult
from shared.datasets.sets import DatasetPhoto

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
        f'<line x1="{MAP_MARGIN_PIXELS}" y1="{y}" x2="{MAP_MARGIN_PIXELS + metres * scale:.1f}" y2="{y}" class="b"/>',
        f'<text x="{MAP_MARGIN_PIXELS + metres * scale + 6:.1f}" y="{y + 4}">{metres:g} m</text>',
    ]
