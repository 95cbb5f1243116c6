"""`@UTM@` file names with all of their fields, written and parsed (`shared.utm_filenames`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime

from shared.utm_filenames import FIELDS, bad_coordinates_error, parse_full_date, utm_to_degrees


@dataclass(frozen=True, slots=True)
class UtmFileName:
    """The fields of an `@UTM@` file name to be written."""

    east: float
    """metres"""
    north: float
    """metres"""
    zone_number: int
    zone_letter: str
    pano_id: str = ""
    heading: float | None = None
    """degrees clockwise from north"""
    captured_at: datetime | None = None
    """UTC"""
    note: str = ""

    def file_name(self) -> str:
        """Format the name; latitude and longitude are computed from the UTM position."""
        if "@" in self.pano_id + self.note:
            raise ValueError("the fields of an @UTM@ file name can't contain an @")
        latitude, longitude = utm_to_degrees(
            self.east, self.north, self.zone_number, self.zone_letter
        )
        fields = (
            f"{self.east:010.2f}",
            f"{self.north:010.2f}",
            f"{self.zone_number:02d}",
            self.zone_letter,
            f"{latitude:+010.6f}" if latitude < 0 else f"{latitude:09.6f}",
            f"{longitude:+011.6f}" if longitude < 0 else f"{longitude:010.6f}",
            self.pano_id,
            "",
            "" if self.heading is None else f"{self.heading % 360:06.2f}",
            "",
            "",
            "",
            f"{self.captured_at:%Y%m%d%H%M%S}" if self.captured_at else "",
            self.note,
        )
        return f"@{'@'.join(fields)}@.jpg"


@dataclass(frozen=True, slots=True)
class FileNameLocation:
    """The location in an `@UTM@` file name; None means that the field is empty."""

    east: float
    """metres"""
    north: float
    zone: str | None
    """such as `32T`"""
    latitude: float | None
    """degrees"""
    longitude: float | None
    heading: float | None
    """degrees clockwise from north, in [0, 360)"""
    note: str
    """free text; gsv_xs stores the place and the city here"""
    captured_at: datetime | None = None
    """UTC; None unless the timestamp is a full date"""


def parse_utm_file_name(name: str) -> FileNameLocation | None:
    """Parse the location of an `@UTM@` file name; None for other names.

    `name` is the file name without folders. Raises InvalidRequest (`bad_coordinates`).
    """
    parts = name.split("@")
    if len(parts) < 4 or parts[0]:
        return None
    try:
        east, north = float(parts[1]), float(parts[2])
        if not math.isfinite(east + north):
            raise ValueError(f"{parts[1]} and {parts[2]} are not finite numbers")
    except ValueError as error:
        raise bad_coordinates_error(name, error) from error
    parts += [""] * (FIELDS - len(parts))
    number, letter, latitude, longitude = parts[3:7]
    return FileNameLocation(
        east,
        north,
        zone=f"{number}{letter}" if number and letter else None,
        latitude=_number(latitude) if longitude else None,
        longitude=_number(longitude) if latitude else None,
        heading=None if (heading := _number(parts[9])) is None else heading % 360,
        note=parts[14],
        captured_at=parse_full_date(parts[13]),
    )


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
