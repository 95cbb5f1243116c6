"""Ground truth: rules for positive matches, and the positives of each query by a rule.

Distances are those of published results: a straight line in UTM metres, the bound included
(VPR-datasets-downloader, deep-visual-geo-localization-benchmark). Across the border of two UTM
zones, whose metres are not comparable, the database is projected into the query's zone.

Memory grows with the number of positives, not with queries x database.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lab.datasets.dataset import PHOTO_TABLE_HEADER, DatasetPhoto, Indices
from lab.datasets.utm_coordinates import group_by_utm_plane, utm_positions
from lab.evaluation.recall import positives_within
from shared.errors import InvalidRequest

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
    """Criterion by which a database photo is a positive of a query."""

    kind: Kind
    radius_m: float = 25.0
    """`radius` and `heading`: maximum distance in metres, inclusive"""
    degrees: float = 40.0
    """`heading`: maximum difference of the headings"""
    frames: int = 0
    """`frames`: maximum difference of the frame numbers"""
    same_sequence: bool = False
    """`frames`: whether both photos must be of the same sequence"""

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
    """Parse a rule such as `radius 25 m`, `heading 25 m 40 deg`, `frames 5 in sequence`.

    Also `place-label`. Units are optional. Raises InvalidRequest (`unknown_rule`).
    """
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
    raise InvalidRequest("unknown_rule", f"Unknown rule {text!r}. Valid rules: {RULE_SYNTAX}.")


def find_positives(
    rule: PositiveRule, queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]
) -> list[Indices]:
    """Find the positives of each query: ascending indices into the database.

    Raises InvalidRequest if photos lack what the rule needs: `no_positions`, `no_headings`,
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
    positives: list[Indices] = [np.empty(0, np.int64)] * len(queries)
    for query_indices, database_indices, query_metres, metres in group_by_utm_plane(
        utm_positions(queries), utm_positions(database)
    ):
        near = positives_within(query_metres, metres, rule.radius_m)
        for query, rows in zip(query_indices.tolist(), near, strict=True):
            positives[query] = database_indices[rows]
    return positives


def _same_heading(
    rule: PositiveRule, queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]
) -> list[Indices]:
    query_headings, headings = (
        _required_values("heading", "no_headings", photos, lambda photo: photo.heading)
        for photos in (queries, database)
    )
    return [
        rows[heading_differences(headings[rows], heading) <= rule.degrees]
        for rows, heading in zip(_within(rule, queries, database), query_headings, strict=True)
    ]


def heading_differences(headings: NDArray[np.float64], heading: float) -> NDArray[np.float64]:
    """Return the angles between headings, 0 to 180 degrees; headings of 360 or more are valid."""
    return np.abs(np.mod(headings - heading + 180.0, 360.0) - 180.0)


def _frames(
    rule: PositiveRule, queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]
) -> list[Indices]:
    query_frames, frames = (
        _required_values("frame number", "no_frames", photos, lambda photo: photo.frame)
        for photos in (queries, database)
    )
    by_sequence: dict[str | None, list[int]] = {}
    for number, photo in enumerate(database):
        by_sequence.setdefault(photo.sequence if rule.same_sequence else None, []).append(number)
    ordered = {
        key: np.array(numbers)[np.argsort(frames[numbers], kind="stable")]
        for key, numbers in by_sequence.items()
    }
    positives = []
    for photo, frame in zip(queries, query_frames, strict=True):
        order = ordered.get(photo.sequence if rule.same_sequence else None, np.empty(0, np.int64))
        first = np.searchsorted(frames[order], frame - rule.frames, "left")
        last = np.searchsorted(frames[order], frame + rule.frames, "right")
        positives.append(np.sort(order[first:last]))
    return positives


def _same_place(queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto]) -> list[Indices]:
    for photos in (queries, database):
        if all(photo.place is None for photo in photos):
            raise _missing_values_error("place label", "no_places", photos)
    by_place: dict[str, list[int]] = {}
    for number, photo in enumerate(database):
        if photo.place is not None:
            by_place.setdefault(photo.place, []).append(number)
    # A query without a label has no positives.
    return [np.array(by_place.get(photo.place or "", []), np.int64) for photo in queries]


def _required_values(
    what: str,
    code: str,
    photos: Sequence[DatasetPhoto],
    get_value: Callable[[DatasetPhoto], float | None],
) -> NDArray[np.float64]:
    values = [get_value(photo) for photo in photos]
    missing = [photo for photo, value in zip(photos, values, strict=True) if value is None]
    if missing:
        raise _missing_values_error(what, code, missing)
    return np.array(values, np.float64)


def _missing_values_error(what: str, code: str, photos: Sequence[DatasetPhoto]) -> InvalidRequest:
    return InvalidRequest(
        code,
        f"{len(photos)} photos have no {what} (first: {photos[0].name}), which this rule needs. "
        f"Add it in a CSV with the header {PHOTO_TABLE_HEADER}, or use another rule.",
    )
