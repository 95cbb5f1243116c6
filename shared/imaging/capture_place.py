"""Where a photo was taken, by the GPS tags of its EXIF or the same properties of its XMP.

A tag is understood, missing, or not understood; the last is never taken for a missing one, because
somebody may write coordinates into a photo that has none. Coordinates of zeros, or of nothing but
0/0, are what a receiver without a fix writes: no place.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

MAX_ALTITUDE_M = 100_000
MAX_HEADING = 720  # cameras count on beyond a turn, but not beyond two
BELOW_ZERO = ("1", "3")  # GPSAltitudeRef: below the sea, below the ellipsoid
NULL_ISLAND_DEGREES = 1e-6
OTHER_DATUM = re.compile("TOKYO|GCJ|BD.?09|NAD.?27|ED.?50")  # some 100 m beside WGS 84
# Numbers with signs and fractions, the marks that programs write between them, and the letter.
NUMBER = r"[+-]?\d+(?:\.\d*)?(?:/\d+)?"
MARKS = "[\\s\u00b0\u00ba'\"\u2019\u2032\u201d\u2033]"
ANGLE = re.compile(
    rf"([NSEW]?)\s*({NUMBER}(?:(?:{MARKS}|,|deg)+{NUMBER}){{0,2}}){MARKS}*([NSEW]?)", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class CapturePlace:
    """Where a photo was taken; None for unknown values."""

    latitude: float | None = None
    """degrees, WGS 84"""
    longitude: float | None = None
    altitude: float | None = None
    """metres"""
    heading: float | None = None
    """degrees clockwise from north, in [0, 360)"""
    heading_is_magnetic: bool = False
    error: str | None = None
    """why there are coordinates that are not understood"""


def is_null_island(latitude: float, longitude: float) -> bool:
    """Return whether coordinates are those of a receiver without a fix: 0, 0."""
    return abs(latitude) < NULL_ISLAND_DEGREES and abs(longitude) < NULL_ISLAND_DEGREES


def read_place(tags: Mapping[str, Any]) -> CapturePlace:
    """Understand GPS tags.

    Args:
        tags: By the names of EXIF. Of EXIF: numbers, tuples, text, bytes, or None for a broken
            value. Of XMP: text.
    """
    altitude = finite_number(tags.get("GPSAltitude"))
    heading = finite_number(tags.get("GPSImgDirection"))
    if altitude is not None and _text(tags.get("GPSAltitudeRef"))[:1] in BELOW_ZERO:
        altitude = -abs(altitude)
    if altitude is not None and abs(altitude) > MAX_ALTITUDE_M:
        altitude = None
    if heading is not None and abs(heading) > MAX_HEADING:
        heading = None
    latitude = longitude = error = None
    try:
        latitude, longitude = _coordinates(tags)
    except ValueError as caught:
        error = str(caught)
    return CapturePlace(
        latitude,
        longitude,
        altitude,
        None if heading is None else heading % 360,
        _text(tags.get("GPSImgDirectionRef"))[:1] == "M",
        error,
    )


def true_heading(place: CapturePlace, time: datetime | None) -> float | None:
    """Return the heading from true north: a magnetic one plus the declination.

    None without a place or time, or for a time that the World Magnetic Models of pygeomag do not
    contain (before 2010).
    """
    if place.heading is None or not place.heading_is_magnetic:
        return place.heading
    if place.latitude is None or place.longitude is None or time is None:
        return None
    from pygeomag import GeoMag  # few photos need it

    try:
        model = GeoMag(base_year=time)  # a new one: it keeps sums, and other threads read photos
        year = time.year + (time.timetuple().tm_yday - 1) / 366
        kilometres = (place.altitude or 0.0) / 1000
        declination = model.calculate(place.latitude, place.longitude, kilometres, year).d
    except ValueError:
        return None
    return round(place.heading + float(declination), 2) % 360


def _coordinates(tags: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Return latitude and longitude, or None for no place; ValueError with a reason."""
    given = [name for name in ("GPSLatitude", "GPSLongitude") if name in tags]
    if not given:
        return None, None
    angles = [
        _angle(name[3:].lower(), tags[name], _text(tags.get(f"{name}Ref")), limit)
        for name, limit in (("GPSLatitude", 90), ("GPSLongitude", 180))
        if name in tags
    ]
    if all(math.isnan(angle) or abs(angle) < NULL_ISLAND_DEGREES for angle in angles):
        return None, None
    if len(given) == 1:
        raise ValueError(f"of its coordinates it has the {given[0][3:].lower()} only")
    if any(map(math.isnan, angles)):
        raise ValueError("one of its coordinates is no number")
    if OTHER_DATUM.match(datum := _text(tags.get("GPSMapDatum"))):
        raise ValueError(f"its coordinates are of the datum {datum[:20]}, not of WGS 84")
    return angles[0], angles[1]


def _angle(name: str, value: Any, reference: str, limit: int) -> float:
    """Return degrees, positive to the north and east; not a number for 0/0.

    Args:
        value: Degrees, minutes and seconds, or fewer of them; a text may contain the letter.
        reference: The letter, or a word that begins with it; empty if there is none.

    Raises:
        ValueError: with the reason.
    """
    letters = "NS" if name == "latitude" else "EW"
    is_text = isinstance(value, str)
    if isinstance(value, str):
        match = ANGLE.fullmatch(value.strip("\0 "))
        if match is None:
            raise ValueError(f"its {name} is {value[:40]!r}")
        reference = (match[1] or match[3] or reference).upper()
        value = tuple(_fraction(text) for text in re.findall(NUMBER, match[2]))
    parts: list[float] = list(value) if isinstance(value, tuple) else [value]
    if not 1 <= len(parts) <= 3 or not all(isinstance(part, int | float) for part in parts):
        raise ValueError(f"its {name} is damaged")
    if all(map(math.isnan, parts)):
        return math.nan
    if not all(map(math.isfinite, parts)):
        raise ValueError(f"a part of its {name} is no number")
    signs = {math.copysign(1, part) for part in parts if part}
    degrees = round(math.fsum(part / 60**index for index, part in enumerate(parts)), 9)
    if not abs(degrees) <= limit or any(abs(part) > 60 for part in parts[1:]) or len(signs) > 1:
        raise ValueError(f"its {name} of {', '.join(f'{part:g}' for part in parts)} does not exist")
    if not degrees:
        return 0.0
    if not reference and is_text and len(parts) == 1:
        return degrees  # signed, as programs write it that know no letters
    if not reference or reference[0] not in letters:
        raise ValueError(f"its {name} has no letter {letters[0]} or {letters[1]}")
    if degrees < 0 and reference[0] == letters[0]:
        raise ValueError(f"its {name} is negative beside the letter {letters[0]}")
    return -abs(degrees) if reference[0] == letters[1] else degrees


def finite_number(value: Any) -> float | None:
    """Return a finite number; also of text such as 4012/10."""
    if isinstance(value, str):
        text = value.strip("\0 ")
        value = _fraction(text) if re.fullmatch(NUMBER, text) else None
    return value if isinstance(value, int | float) and math.isfinite(value) else None


def _fraction(text: str) -> float:
    numerator, _, denominator = text.partition("/")
    number, divisor = float(numerator), float(denominator or 1)
    return number / divisor if divisor else math.inf * number


def _text(value: Any) -> str:
    """Return text in capitals, also of a number, or of bytes that are one or stand for letters."""
    if isinstance(value, bytes):
        value = str(value[0]) if value[:1] < b"\x20" and value else value.decode("latin-1")
    return "" if value is None else str(value).strip("\0 ").upper()
