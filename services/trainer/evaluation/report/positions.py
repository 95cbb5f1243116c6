"""Where queries were taken and where their first match lies: a map in metres, as SVG."""

from __future__ import annotations

from collections import Counter

import numpy as np

from services.trainer.evaluation.result import Result
from shared.datasets.sets import Shot

SIDE = 620  # pixels
MARGIN = 12
DATABASE_SHOWN = 4000
QUERIES_SHOWN = 2000
BAR_SHARE = 0.25  # of the width that the scale's bar takes at most


def positions_chart(result: Result) -> tuple[str, str] | None:
    """The `<svg>` and what it leaves out; None where there are no positions to draw."""
    zone = _usual_zone(result.asked.queries)
    database = [_point(shot, zone) for shot in result.asked.database]
    queries = [_point(shot, zone) for shot in result.asked.queries]
    drawn = [q for q, point in enumerate(queries) if point is not None]
    seen = [point for point in (*database, *queries) if point is not None]
    if not drawn or not any(point is not None for point in database):
        return None
    east, north = np.array(seen).T
    low, high = np.array([east.min(), north.min()]), np.array([east.max(), north.max()])
    span = float(max(*(high - low), 1.0))
    scale = (SIDE - 2 * MARGIN) / span
    height = int((high[1] - low[1]) * scale) + 2 * MARGIN + 24

    def at(point: tuple[float, float]) -> tuple[float, float]:
        x = MARGIN + (point[0] - low[0]) * scale
        return x, height - 24 - MARGIN - (point[1] - low[1]) * scale

    label = "Map of queries and their first matches"
    parts = [f'<svg viewBox="0 0 {SIDE} {height}" role="img" class="m" aria-label="{label}">']
    there = [point for point in database if point is not None]
    parts += [
        '<circle cx="{:.1f}" cy="{:.1f}" r="1.5" class="d"/>'.format(*at(point))
        for point in there[:: max(1, -(-len(there) // DATABASE_SHOWN))]
    ]
    shown = drawn[:: max(1, -(-len(drawn) // QUERIES_SHOWN))]
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
    parts += [*_bar(span, scale, height), "</svg>"]
    said = f"{len(shown)} of {len(queries)} queries, zone {zone or 'not said'}"
    return "".join(parts), said


def _usual_zone(shots: tuple[Shot, ...]) -> str | None:
    zones = Counter(shot.zone for shot in shots if shot.easting is not None)
    return zones.most_common(1)[0][0] if zones else None


def _point(shot: Shot, zone: str | None) -> tuple[float, float] | None:
    if shot.easting is None or shot.northing is None or shot.zone != zone:
        return None
    return shot.easting, shot.northing


def _bar(span: float, scale: float, height: int) -> list[str]:
    """A bar of 1, 2 or 5 times a power of ten metres."""
    least = span * BAR_SHARE / 2
    power = 10.0 ** np.floor(np.log10(least))
    metres = next(m for m in (power, 2 * power, 5 * power, 10 * power) if m >= least)
    y = height - 12
    return [
        f'<line x1="{MARGIN}" y1="{y}" x2="{MARGIN + metres * scale:.1f}" y2="{y}" class="b"/>',
        f'<text x="{MARGIN + metres * scale + 6:.1f}" y="{y + 4}">{metres:g} m</text>',
    ]
