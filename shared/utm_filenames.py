"""The `@UTM@` file names of visual place recognition datasets.

`@ UTM_east @ UTM_north @ zone_number @ zone_letter @ latitude @ longitude @ pano_id @ tile @
heading @ pitch @ roll @ height @ timestamp @ note @ .jpg`; only the first two are always present.
(github.com/gmberton/VPR-datasets-downloader, "Images naming convention")
"""

from __future__ import annotations

import contextlib
from datetime import UTC, datetime

import utm

from shared.errors import InvalidRequest

BANDS = "CDEFGHJKLMNPQRSTUVWX"  # of 8 degrees, from 80 S; the last has 12
BAND_TOLERANCE = 0.1  # degrees: photos of a town on the border of two have one letter
FIELDS = 16  # 14 between the first and the last `@`; splitting gives two more
FULL_DATES = {8: "%Y%m%d", 14: "%Y%m%d%H%M%S"}  # by length; a year or a month alone is not a date


def upload_fields_of_file_name(name: str, utm_zone: str | None) -> dict[str, str]:
    """Parse an `@UTM@` file name into fields of the upload form; {} for other names.

    `utm_zone` (such as `32T`) is the zone of names without one. A timestamp becomes `captured_at`
    only if it is a full date; `201905` names a month only.

    Raises InvalidRequest: `no_utm_zone`, `bad_coordinates`.
    """
    parts = name.split("@")
    if len(parts) < 4 or parts[0]:
        return {}
    parts += [""] * (FIELDS - len(parts))
    east, north, number, letter, latitude, longitude = parts[1:7]
    if not (latitude and longitude):
        zone = f"{number}{letter}" if number and letter else utm_zone
        if zone is None:
            raise InvalidRequest(
                "no_utm_zone",
                f"{name} has UTM east and north but no zone. Pass it, for example --utm-zone 32T.",
            )
        try:
            degrees = utm_to_degrees(float(east), float(north), int(zone[:-1]), zone[-1].upper())
        except (ValueError, utm.OutOfRangeError) as error:
            raise bad_coordinates_error(name, error) from error
        latitude, longitude = f"{degrees[0]:.7f}", f"{degrees[1]:.7f}"
    fields = {"latitude": latitude, "longitude": longitude}
    with contextlib.suppress(ValueError):  # the heading is optional in the convention
        fields["heading"] = f"{float(parts[9]) % 360:g}"
    captured_at = parse_full_date(parts[13])
    if captured_at:
        fields["captured_at"] = captured_at.isoformat()
    return fields


def utm_to_degrees(east: float, north: float, number: int, letter: str) -> tuple[float, float]:
    """Convert UTM metres to degrees.

    Raises:
        ValueError: The northing is not in the band of the letter: an S may stand for the south.
        utm.OutOfRangeError: A number is out of range.
    """
    latitude, longitude = map(float, utm.to_latlon(east, north, number, letter))
    south = -80 + 8 * BANDS.index(letter)
    north_end = 84 if letter == BANDS[-1] else south + 8
    if south - BAND_TOLERANCE <= latitude <= north_end + BAND_TOLERANCE:
        return latitude, longitude
    readings = []
    for northern in (True, False):
        with contextlib.suppress(utm.OutOfRangeError):
            other = float(utm.to_latlon(east, north, number, northern=northern)[0])
            band = utm.latitude_to_zone_letter(other)
            readings.append(f"{number}{band} for {abs(other):.2f} {'N' if northern else 'S'}")
    degrees = f"{south} to {north_end} N" if south >= 0 else f"{-south} to {-north_end} S"
    raise ValueError(
        f"northing {north:,.0f} is not in band {letter} ({degrees}); pass "
        f"the letter of its band: {' or '.join(readings)}"
    )


def parse_full_date(timestamp: str) -> datetime | None:
    """Parse a timestamp of a date or of date and time; None for others."""
    digits = timestamp.replace("_", "")
    pattern = FULL_DATES.get(len(digits)) if digits.isdecimal() and digits.isascii() else None
    if pattern is None:
        return None
    try:
        return datetime.strptime(digits, pattern).replace(tzinfo=UTC)
    except ValueError:  # not a date, such as month 13
        return None


def bad_coordinates_error(name: str, error: Exception) -> InvalidRequest:
    return InvalidRequest(
        "bad_coordinates", f"{name}: its UTM coordinates can't be read ({error})."
    )
