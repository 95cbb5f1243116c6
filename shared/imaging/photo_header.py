"""Photo headers: size, location and capture time, read without decoding pixels.

EXIF is untrusted: fields that are missing, broken or out of range become None. The cost of a header
is bounded whatever the file says (`shared.imaging.bounded_reader`).
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, BinaryIO, cast

from PIL.ExifTags import GPS, IFD, Base

from shared.errors import Unprocessable
from shared.geometry.cameras import focal_length_from_exif
from shared.imaging.exif import TiffBlock
from shared.imaging.file_formats import PHOTO_READ_ERRORS, check_pixel_count
from shared.imaging.file_structure import read_structure

MAIN_TAGS = (Base.Orientation, Base.Make, Base.Model, IFD.Exif, IFD.GPSInfo)
CAMERA_TAGS = (
    *(Base.DateTimeOriginal, Base.OffsetTimeOriginal, Base.BodySerialNumber),
    *(Base.FocalLengthIn35mmFilm, Base.FocalLength),
    *(Base.FocalPlaneXResolution, Base.FocalPlaneResolutionUnit),
    *(Base.ExifImageWidth, Base.ExifImageHeight),
)
GPS_TAGS = (
    GPS.GPSLatitudeRef,
    GPS.GPSLatitude,
    GPS.GPSLongitudeRef,
    GPS.GPSLongitude,
    GPS.GPSAltitudeRef,
    GPS.GPSAltitude,
    GPS.GPSTimeStamp,
    GPS.GPSDateStamp,
    GPS.GPSImgDirection,
)
ROTATED_ORIENTATIONS = (5, 6, 7, 8)  # EXIF orientations that swap width and height
QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3, **dict.fromkeys((2, 4, 5, 7))}  # clockwise; None: mirrored
BELOW_ZERO = (b"\1", b"\3")  # GPSAltitudeRef: below the sea, below the ellipsoid
MAX_ALTITUDE_M = 100_000
EXIF_INCH = 2  # the default of FocalPlaneResolutionUnit


@dataclass(frozen=True, slots=True)
class PhotoHeader:
    """Size, location and capture time of a photo; None for unknown values."""

    width: int
    """pixels, upright"""
    height: int
    latitude: float | None = None
    """degrees, WGS 84"""
    longitude: float | None = None
    altitude: float | None = None
    """metres, as the camera's GPS gives them"""
    heading: float | None = None
    """degrees clockwise from north, in [0, 360)"""
    captured_at: datetime | None = None
    """UTC; if `time_zone_is_known` is False, the camera's clock as if it were UTC"""
    time_zone_is_known: bool = False
    camera: str | None = None
    """make, model and serial number"""
    focal_length: float | None = None
    """multiple of the longer side"""
    quarter_turns: int | None = 0
    """clockwise, by which EXIF says that the pixels are turned upright; None if also mirrored"""

    @property
    def camera_key(self) -> str | None:
        """What photos of one camera, zoom and size have in common; None without make and model."""
        if self.camera is None or self.quarter_turns is None:
            return None
        size = (self.width, self.height)[:: -1 if self.quarter_turns % 2 else 1]
        return f"{self.camera} {size[0]}x{size[1]} {self.focal_length or 0:.3f}"


def read_photo_header(file: BinaryIO, max_pixels: int) -> PhotoHeader:
    """Read a photo's header from its beginning.

    Raises Unprocessable: `undecodable_photo`, `too_many_pixels`.
    """
    try:
        structure = read_structure(file)
    except (OSError, ValueError) as error:
        raise Unprocessable("undecodable_photo", f"The photo can't be decoded: {error}.") from error
    width, height, exif = structure.width, structure.height, structure.exif
    check_pixel_count(width, height, max_pixels)
    main = _directory(exif, exif and exif.first_offset, MAIN_TAGS)
    orientation = 1 if structure.is_upright else main.get(Base.Orientation)
    if orientation in ROTATED_ORIENTATIONS:
        width, height = height, width
    details = _directory(exif, main.get(IFD.Exif), CAMERA_TAGS)
    gps = _directory(exif, main.get(IFD.GPSInfo), GPS_TAGS)
    latitude = _degrees(gps.get(GPS.GPSLatitude), gps.get(GPS.GPSLatitudeRef), "NS", limit=90)
    longitude = _degrees(gps.get(GPS.GPSLongitude), gps.get(GPS.GPSLongitudeRef), "EW", limit=180)
    if latitude is None or longitude is None:
        latitude = longitude = None
    heading = _number(gps.get(GPS.GPSImgDirection))
    gps_time = _gps_time(gps)
    clock, time_zone_is_known = _clock_time(details)
    return PhotoHeader(
        width=width,
        height=height,
        latitude=latitude,
        longitude=longitude,
        altitude=_altitude(gps),
        heading=heading % 360 if heading is not None else None,
        captured_at=gps_time or clock,
        time_zone_is_known=gps_time is not None or time_zone_is_known,
        camera=_camera(main, details),
        focal_length=_focal_length(details, structure.width, structure.height),
        quarter_turns=QUARTER_TURNS.get(orientation, 0) if isinstance(orientation, int) else 0,
    )


def _directory(exif: TiffBlock | None, offset: Any, tags: Collection[int]) -> dict[int, Any]:
    """Return the given tags of one of EXIF's directories; empty if it is missing or broken."""
    if exif is None or not isinstance(offset, int):
        return {}
    try:
        return exif.read_directory(offset, tags)
    except PHOTO_READ_ERRORS:
        return {}


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _degrees(parts: Any, reference: Any, signs: str, limit: float) -> float | None:
    """Convert EXIF's (degrees, minutes, seconds); `signs` are the letters of + and -.

    Returns None without a valid letter, because the hemisphere is unknown.
    """
    if not isinstance(parts, tuple) or len(parts) != 3 or not isinstance(reference, str):
        return None
    sign = signs.find(reference.strip("\0 ").upper()[:1] or "?")
    if sign < 0:
        return None
    numbers = [_number(part) for part in parts]
    if any(number is None for number in numbers):
        return None
    degrees, minutes, seconds = (number or 0.0 for number in numbers)
    value = degrees + minutes / 60 + seconds / 3600
    if sign:
        value = -value
    return value if abs(value) <= limit else None


def _altitude(gps: dict[int, Any]) -> float | None:
    altitude = _number(gps.get(GPS.GPSAltitude))
    if altitude is None or not abs(altitude) <= MAX_ALTITUDE_M:
        return None
    return -altitude if gps.get(GPS.GPSAltitudeRef) in BELOW_ZERO else altitude


def _focal_length(details: dict[int, Any], width: int, height: int) -> float | None:
    # The resolution is that of the photo as it was taken: this file may be a smaller copy.
    taken = details.get(Base.ExifImageWidth), details.get(Base.ExifImageHeight)
    if all(isinstance(side, int) and side > 0 for side in taken):
        width, height = cast("tuple[int, int]", taken)
    return focal_length_from_exif(
        width,
        height,
        _number(details.get(Base.FocalLengthIn35mmFilm)),
        _number(details.get(Base.FocalLength)),
        _number(details.get(Base.FocalPlaneXResolution)),
        details.get(Base.FocalPlaneResolutionUnit, EXIF_INCH),
    )


def _camera(main: dict[int, Any], details: dict[int, Any]) -> str | None:
    texts = [main.get(Base.Make), main.get(Base.Model), details.get(Base.BodySerialNumber)]
    known = [text.strip("\0 ") for text in texts if isinstance(text, str)]
    return " ".join(filter(None, known)) or None


def _gps_time(gps: dict[int, Any]) -> datetime | None:
    """Return the GPS time, which is UTC."""
    day, clock = gps.get(GPS.GPSDateStamp), gps.get(GPS.GPSTimeStamp)
    if not (isinstance(day, str) and isinstance(clock, tuple) and len(clock) == 3):
        return None
    parts = [_number(part) for part in clock]
    if any(part is None for part in parts):
        return None
    hours, minutes, seconds = (part or 0.0 for part in parts)
    try:
        midnight = datetime.strptime(day.strip("\0 "), "%Y:%m:%d").replace(tzinfo=UTC)
        return midnight + timedelta(hours=hours, minutes=minutes, seconds=seconds)
    except (ValueError, OverflowError):
        return None


def _clock_time(details: dict[int, Any]) -> tuple[datetime | None, bool]:
    """Return the time of the camera's clock (UTC without an offset), and if it has an offset."""
    taken = details.get(Base.DateTimeOriginal)
    offset = details.get(Base.OffsetTimeOriginal)
    if not isinstance(taken, str):
        return None, False
    try:
        local = datetime.strptime(taken.strip("\0 "), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
        if isinstance(offset, str) and offset.strip("\0 "):
            zone = datetime.fromisoformat(f"2000-01-01T00:00:00{offset.strip(chr(0) + ' ')}").tzinfo
            return local.replace(tzinfo=zone or UTC).astimezone(UTC), zone is not None
        return local, False
    except (ValueError, OverflowError):
        return None, False
