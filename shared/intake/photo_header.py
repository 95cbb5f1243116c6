"""What a photo's header says, read without decoding a pixel: size, and where and when it was taken.

EXIF is a hint from a stranger: whatever is missing, broken or out of range is left out.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, BinaryIO

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from shared.errors import Unprocessable
from shared.intake.heic_header import read_heic_header
from shared.photo_formats import (
    HEIC_MEDIA_TYPE,
    PHOTO_READ_ERRORS,
    PHOTO_SIGNATURE_BYTES,
    check_pixel_count,
    detect_media_type,
    open_photo,
)

ROTATED_ORIENTATIONS = (5, 6, 7, 8)  # EXIF orientations that swap width and height


@dataclass(frozen=True, slots=True)
class PhotoHeader:
    width: int
    """pixels, upright"""
    height: int
    latitude: float | None = None
    """degrees, WGS 84"""
    longitude: float | None = None
    heading: float | None = None
    """degrees clockwise from north, in [0, 360)"""
    captured_at: datetime | None = None


def read_photo_header(file: BinaryIO, max_pixels: int) -> PhotoHeader:
    """Unprocessable (`undecodable_photo`, `too_many_pixels`) when the header can't be used."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # strange EXIF is no reason to refuse a photo
            begin = file.read(PHOTO_SIGNATURE_BYTES)
            file.seek(0)
            if detect_media_type(begin) == HEIC_MEDIA_TYPE:
                return _heic_header(file, max_pixels)
            with open_photo(file) as image:
                check_pixel_count(image.width, image.height, max_pixels)
                return _header(image)
    except PHOTO_READ_ERRORS as error:
        raise Unprocessable(
            "undecodable_photo", "The photo's header is broken: it can't be decoded."
        ) from error


def _header(image: Image.Image) -> PhotoHeader:
    width, height = image.size
    exif = _exif(image)
    # Pillow gives the size of a TIFF as it stands upright, that of all others as stored.
    if image.format != "TIFF" and _orientation(exif) in ROTATED_ORIENTATIONS:
        width, height = height, width
    return _with_exif(width, height, exif)


def _heic_header(file: BinaryIO, max_pixels: int) -> PhotoHeader:
    """Its size is that of the boxes: EXIF's orientation does not count in HEIC."""
    found = read_heic_header(file)
    check_pixel_count(found.width, found.height, max_pixels)
    exif = Image.Exif()
    if found.exif:
        with contextlib.suppress(*PHOTO_READ_ERRORS):
            exif.load(found.exif)
    return _with_exif(found.width, found.height, exif)


def _with_exif(width: int, height: int, exif: Image.Exif) -> PhotoHeader:
    gps = _directory(exif, IFD.GPSInfo)
    latitude = _degrees(gps.get(GPS.GPSLatitude), gps.get(GPS.GPSLatitudeRef), "NS", limit=90)
    longitude = _degrees(gps.get(GPS.GPSLongitude), gps.get(GPS.GPSLongitudeRef), "EW", limit=180)
    if latitude is None or longitude is None:
        latitude = longitude = None
    heading = _number(gps.get(GPS.GPSImgDirection))
    return PhotoHeader(
        width=width,
        height=height,
        latitude=latitude,
        longitude=longitude,
        heading=heading % 360 if heading is not None else None,
        captured_at=_captured_at(gps, _directory(exif, IFD.Exif)),
    )


def _exif(image: Image.Image) -> Image.Exif:
    """The EXIF block; for PNG only if it stands before the pixels, which are not decoded here."""
    exif = Image.Exif()
    try:
        if image.format == "TIFF":
            return image.getexif()
        if block := image.info.get("exif"):
            exif.load(block)
    except PHOTO_READ_ERRORS:
        return Image.Exif()
    return exif


def _orientation(exif: Image.Exif) -> Any:
    try:
        return exif.get(Base.Orientation)
    except PHOTO_READ_ERRORS:
        return None


def _directory(exif: Image.Exif, tag: int) -> dict[int, Any]:
    """One of EXIF's inner directories; empty when it is broken."""
    try:
        return dict(exif.get_ifd(tag))
    except PHOTO_READ_ERRORS:
        return {}


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _degrees(parts: Any, reference: Any, signs: str, limit: float) -> float | None:
    """EXIF's (degrees, minutes, seconds) as one number; `signs` are the letters of + and -.

    Without either letter it is left out: the other hemisphere is no small error.
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


def _captured_at(gps: dict[int, Any], exif: dict[int, Any]) -> datetime | None:
    """GPS time, which is UTC; else the camera's clock with its offset (none given: UTC)."""
    day, clock = gps.get(GPS.GPSDateStamp), gps.get(GPS.GPSTimeStamp)
    if isinstance(day, str) and isinstance(clock, tuple) and len(clock) == 3:
        parts = [_number(part) for part in clock]
        if all(part is not None for part in parts):
            hours, minutes, seconds = (part or 0.0 for part in parts)
            try:
                midnight = datetime.strptime(day.strip("\0 "), "%Y:%m:%d").replace(tzinfo=UTC)
                return midnight + timedelta(hours=hours, minutes=minutes, seconds=seconds)
            except (ValueError, OverflowError):
                pass  # fall through to the camera's clock
    taken = exif.get(Base.DateTimeOriginal)
    offset = exif.get(Base.OffsetTimeOriginal)
    if not isinstance(taken, str):
        return None
    try:
        local = datetime.strptime(taken.strip("\0 "), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
        if isinstance(offset, str) and offset.strip("\0 "):
            zone = datetime.fromisoformat(f"2000-01-01T00:00:00{offset.strip(chr(0) + ' ')}").tzinfo
            return local.replace(tzinfo=zone or UTC).astimezone(UTC)
        return local
    except (ValueError, OverflowError):
        return None
