"""Which database photos are right for each query, by a rule; in memory that grows with the answer.

The distance is that of published figures: a straight line in UTM metres, its bound included
(VPR-datasets-downloader, deep-visual-geo-localization-benchmark). Over the border of two UTM zones,
where their metres mean nothing to each other, the database is projected into the query's zone.

Who counts as showing the same place: the rules of ground truth, as people write them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from shared.datasets.dataset import DatasetPhoto, Indices
from shared.datasets.utm_coordinates import group_by_utm_plane, utm_positions
from shared.errors import InvalidRequest
from shared.evaluation.recall import positives_within

Kind = Literal["radius", "heading", "frames", "place-label"]

RULE_SYNTAX = (
    "radius METRES, heading METRES DEGREES, frames COUNT, frames COUNT in sequence, place-label"
)
_NUMBER = r"(\d+(?:\.\d+)?)"
_PATTERNS = {
    "radius": re.compile(rf"radius(?:[ :]+{_NUMBER}(?: ?m)?)?"),
    "heading": re.compile(rf"heading(?:[ :]+{_NUMBER}(?: ?m)?[ :,]+{_NUMBER}(?: ?deg)?)?"),
    "frames": re.compile(r"frames[ :]+(\d+)( in sequence)?"),
    "place-label": re.compile(r"place-label"),
}


@dataclass(frozen=True, slots=True)
class PositiveRule:
    """A database photo is a positive of a query when they meet all that is said here."""

    kind: Kind
    radius_m: float = 25.0
    """`radius` and `heading`: at most so far apart, in metres; the bound is included"""
    degrees: float = 40.0
    """`heading`: looking ways that differ by at most so much"""
    frames: int = 0
    """`frames`: at most so many frames apart"""
    same_sequence: bool = False
    """`frames`: and of the same sequence"""

    def __str__(self) -> str:
        match self.kind:
            case "radius":
                return f"radius {self.radius_m:g} m"
            case "heading":
                return f"heading {self.radius_m:g} m {self.degrees:g} deg"
            case "frames":
                return f"frames {self.frames}" + (" in sequence" if self.same_sequence else "")
            case "place-label":
                return "place-label"


def parse_rule(text: str) -> PositiveRule:
    """`radius 25 m`, `heading 25 m 40 deg`, `frames 5 in sequence`, `place-label`; units may be
    left out. Raises InvalidRequest (`unknown_rule`)."""
    cleaned = " ".join(text.lower().split())
    if match := _PATTERNS["radius"].fullmatch(cleaned):
        return PositiveRule("radius", radius_m=float(match[1] or 25))
    if match := _PATTERNS["heading"].fullmatch(cleaned):
        degrees = float(match[2] or 40)
        if degrees <= 180:
            return PositiveRule("heading", radius_m=float(match[1] or 25), degrees=degrees)
    if match := _PATTERNS["frames"].fullmatch(cleaned):
        return PositiveRule("frames", frames=int(match[1]), same_sequence=bool(match[2]))
    if _PATTERNS["place-label"].fullmatch(cleaned):
        return PositiveRule("place-label")
    raise InvalidRequest("unknown_rule", f"There is no rule {text!r}. Known are: {RULE_SYNTAX}.")


def find_positives(
    rule: PositiveRule, queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]
) -> list[Indices]:
    """For each query the ascending indices of its positives in the database.

    Raises InvalidRequest where photos don't say what the rule needs: `no_positions`, `no_headings`,
    `no_frames`, `no_places`.
    """
    match rule.kind:
        case "radius":
            return _within(rule, queries, database)
        case "heading":
            return _same_heading(rule, queries, database)
        case "frames":
            return _frames(rule, queries, database)
        case "place-label":
            return _same_place(queries, database)


def _within(
    rule: PositiveRule, queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]
) -> list[Indices]:
    found: list[Indices] = [np.empty(0, np.int64)] * len(queries)
    for asked, kept, query_metres, metres in group_by_utm_plane(
        utm_positions(queries), utm_positions(database)
    ):
        near = positives_within(query_metres, metres, rule.radius_m)
        for number, positives in zip(asked.tolist(), near, strict=True):
            found[number] = kept[positives]
    return found


def _same_heading(
    rule: PositiveRule, queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]
) -> list[Indices]:
    asked = _required_values("heading", "no_headings", queries, lambda shot: shot.heading)
    looking = _required_values("heading", "no_headings", database, lambda shot: shot.heading)
    found = _within(rule, queries, database)
    return [
        near[heading_differences(looking[near], heading) <= rule.degrees]
        for near, heading in zip(found, asked, strict=True)
    ]


def heading_differences(
    headings: np.ndarray[tuple[int, ...], np.dtype[np.float64]], heading: float
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Angles between looking ways, 0 to 180 degrees; a heading may be of any turn, such as 370."""
    return np.abs(np.mod(headings - heading + 180.0, 360.0) - 180.0)


def _frames(
    rule: PositiveRule, queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]
) -> list[Indices]:
    asked = _required_values("frame number", "no_frames", queries, lambda shot: shot.frame).astype(
        np.int64
    )
    frames = _required_values(
        "frame number", "no_frames", database, lambda shot: shot.frame
    ).astype(np.int64)
    groups: dict[str | None, list[int]] = {}
    for number, shot in enumerate(database):
        groups.setdefault(shot.sequence if rule.same_sequence else None, []).append(number)
    ordered = {
        key: np.array(numbers)[np.argsort(frames[numbers], kind="stable")]
        for key, numbers in groups.items()
    }
    found = []
    for shot, frame in zip(queries, asked, strict=True):
        order = ordered.get(shot.sequence if rule.same_sequence else None, np.empty(0, np.int64))
        first = np.searchsorted(frames[order], frame - rule.frames, "left")
        last = np.searchsorted(frames[order], frame + rule.frames, "right")
        found.append(np.sort(order[first:last]))
    return found


def _same_place(queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]) -> list[Indices]:
    for shots in (queries, database):
        if all(shot.place is None for shot in shots):
            raise _missing_values_error("place label", "no_places", shots)
    by_place: dict[str, list[int]] = {}
    for number, shot in enumerate(database):
        if shot.place is not None:
            by_place.setdefault(shot.place, []).append(number)
    # A query without a label is of no place that the database knows.
    return [np.array(by_place.get(shot.place or "", []), np.int64) for shot in queries]


def _required_values(
    what: str, code: str, shots: Sequence[DatasetPhoto], of: Callable[[DatasetPhoto], float | None]
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    values = [of(shot) for shot in shots]
    lacking = [shot for shot, value in zip(shots, values, strict=True) if value is None]
    if lacking:
        raise _missing_values_error(what, code, lacking)
    return np.array(values, np.float64)


def _missing_values_error(what: str, code: str, shots: Sequence[DatasetPhoto]) -> InvalidRequest:
    return InvalidRequest(
        code,
        f"{len(shots)} photos say no {what} (the first: {shots[0].name}), which this rule needs. "
        "Give it in a CSV, or take another rule.",
    )
