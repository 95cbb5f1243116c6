"""Photos that tests make: each number is another photo, the same on every run."""

from __future__ import annotations

import io
from datetime import datetime
from typing import Any

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from shared.imaging.capture_place import read_place
from shared.imaging.xmp import read_xmp

UNDO_OF_ORIENTATION = {
    1: None,
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


def photo_image(number: int, width: int = 64, height: int = 48) -> Image.Image:
    """Coarse random colours, so that two numbers are far apart for every extractor."""
    rng = np.random.default_rng(number)
    coarse = Image.fromarray(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8))
    return coarse.resize((width, height), Image.Resampling.NEAREST)


def encoded(image: Image.Image, media: str, **options: Any) -> bytes:
    """A file of the given Pillow format."""
    buffer = io.BytesIO()
    image.save(buffer, media, **options)
    return buffer.getvalue()


def photo_bytes(number: int, media: str = "JPEG", **options: Any) -> bytes:
    """The photo `number` as a file of the given Pillow format."""
    return encoded(photo_image(number), media, **options)


def near_copy(number: int) -> bytes:
    """The photo `number` a little darker: other bytes, the same place."""
    darker = photo_image(number).point(lambda value: int(value * 0.9))
    return encoded(darker, "JPEG", quality=80)


def turned_photo(upright: Image.Image, orientation: int, media: str, **options: Any) -> bytes:
    """The photo as a camera held otherwise stores it: turned, and its EXIF saying how."""
    undo = UNDO_OF_ORIENTATION[orientation]
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    stored = upright if undo is None else upright.transpose(undo)
    return encoded(stored, media, exif=exif, **options)


def camera_exif(
    clock: datetime | None = None,
    position: tuple[float, float] | None = None,
    *,
    offset: str | None = None,
    model: str | None = None,
    serial: str | None = None,
) -> Image.Exif:
    """EXIF with what is given: the camera, its clock, and a position as below."""
    exif = Image.Exif() if position is None else exif_with_position(*position)
    details: dict[int, str | None] = {
        Base.DateTimeOriginal: None if clock is None else f"{clock:%Y:%m:%d %H:%M:%S}",
        Base.OffsetTimeOriginal: offset,
        Base.BodySerialNumber: serial,
    }
    if given := {tag: value for tag, value in details.items() if value}:
        exif.get_ifd(IFD.Exif).update(given)
    if model:
        exif[Base.Model] = model
    return exif


def exif_with_position(latitude: float, longitude: float) -> Image.Exif:
    """EXIF with coordinates in degrees, north and east if they are positive."""
    exif = Image.Exif()
    gps = exif.get_ifd(IFD.GPSInfo)
    gps[GPS.GPSLatitudeRef], gps[GPS.GPSLatitude] = "SN"[latitude > 0], (abs(latitude), 0.0, 0.0)
    gps[GPS.GPSLongitudeRef], gps[GPS.GPSLongitude] = (
        "WE"[longitude > 0],
        (abs(longitude), 0.0, 0.0),
    )
    return exif


def sidecar_position(xmp: bytes) -> tuple[float | None, float | None]:
    """Latitude and longitude of an XMP packet."""
    place = read_place(read_xmp(xmp))
    return place.latitude, place.longitude
