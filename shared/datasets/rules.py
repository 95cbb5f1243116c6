"""Who counts as showing the same place: the rules of ground truth, as people write them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

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
