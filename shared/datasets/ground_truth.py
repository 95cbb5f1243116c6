"""Which database photos are right for each query, by a rule; in memory that grows with the answer.

The distance is that of published figures: a straight line in UTM metres, its bound included
(VPR-datasets-downloader, deep-visual-geo-localization-benchmark). Over the border of two UTM zones,
where their metres mean nothing to each other, the database is projected into the query's zone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from shared.datasets.recall import true_positives
from shared.datasets.rules import Rule
from shared.datasets.shots import Indices, Shot
from shared.datasets.zones import planes, positions_of
from shared.errors import InvalidRequest


def find_positives(rule: Rule, queries: Sequence[Shot], database: Sequence[Shot]) -> list[Indices]:
    """For each query the ascending indices of its positives in the database.

    Raises InvalidRequest where photos don't say what the rule needs: `no_positions`, `no_headings`,
    `no_frames`, `no_places`.
    """
    match rule.kind:
        case "radius":
            return _within(rule, queries, database)
        case "heading":
            return _looking_alike(rule, queries, database)
        case "frames":
            return _frames(rule, queries, database)
        case "place-label":
            return _same_place(queries, database)


def _within(rule: Rule, queries: Sequence[Shot], database: Sequence[Shot]) -> list[Indices]:
    found: list[Indices] = [np.empty(0, np.int64)] * len(queries)
    for asked, kept, query_metres, metres in planes(positions_of(queries), positions_of(database)):
        near = true_positives(query_metres, metres, rule.radius_m)
        for number, positives in zip(asked.tolist(), near, strict=True):
            found[number] = kept[positives]
    return found


def _looking_alike(rule: Rule, queries: Sequence[Shot], database: Sequence[Shot]) -> list[Indices]:
    asked = _said("heading", "no_headings", queries, lambda shot: shot.heading)
    looking = _said("heading", "no_headings", database, lambda shot: shot.heading)
    found = _within(rule, queries, database)
    return [
        near[degrees_apart(looking[near], heading) <= rule.degrees]
        for near, heading in zip(found, asked, strict=True)
    ]


def degrees_apart(
    headings: np.ndarray[tuple[int, ...], np.dtype[np.float64]], heading: float
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Angles between looking ways, 0 to 180 degrees; a heading may be of any turn, such as 370."""
    return np.abs(np.mod(headings - heading + 180.0, 360.0) - 180.0)


def _frames(rule: Rule, queries: Sequence[Shot], database: Sequence[Shot]) -> list[Indices]:
    asked = _said("frame number", "no_frames", queries, lambda shot: shot.frame).astype(np.int64)
    frames = _said("frame number", "no_frames", database, lambda shot: shot.frame).astype(np.int64)
    groups: dict[str | None, list[int]] = {}
    for number, shot in enumerate(database):
        groups.setdefault(shot.sequence if rule.in_sequence else None, []).append(number)
    ordered = {
        key: np.array(numbers)[np.argsort(frames[numbers], kind="stable")]
        for key, numbers in groups.items()
    }
    found = []
    for shot, frame in zip(queries, asked, strict=True):
        order = ordered.get(shot.sequence if rule.in_sequence else None, np.empty(0, np.int64))
        first = np.searchsorted(frames[order], frame - rule.frames, "left")
        last = np.searchsorted(frames[order], frame + rule.frames, "right")
        found.append(np.sort(order[first:last]))
    return found


def _same_place(queries: Sequence[Shot], database: Sequence[Shot]) -> list[Indices]:
    for shots in (queries, database):
        if all(shot.place is None for shot in shots):
            raise _lacking("place label", "no_places", shots)
    by_place: dict[str, list[int]] = {}
    for number, shot in enumerate(database):
        if shot.place is not None:
            by_place.setdefault(shot.place, []).append(number)
    # A query without a label is of no place that the database knows.
    return [np.array(by_place.get(shot.place or "", []), np.int64) for shot in queries]


def _said(
    what: str, code: str, shots: Sequence[Shot], of: Callable[[Shot], float | None]
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    values = [of(shot) for shot in shots]
    lacking = [shot for shot, value in zip(shots, values, strict=True) if value is None]
    if lacking:
        raise _lacking(what, code, lacking)
    return np.array(values, np.float64)


def _lacking(what: str, code: str, shots: Sequence[Shot]) -> InvalidRequest:
    return InvalidRequest(
        code,
        f"{len(shots)} photos say no {what} (the first: {shots[0].name}), which this rule needs. "
        "Give it in a CSV, or take another rule.",
    )
