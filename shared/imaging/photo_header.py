"""Photo headers: size, location and capture time, read without decoding pixels.

EXIF is untrusted: fields that are missing, broken or out of range become None.

HEIC is parsed here, without its decoder, which is optional. A HEIC file is a tree of boxes (ISO/IEC
14496-12): each has a length, a name of four letters and content. `meta` lists the items (ISO/IEC
23008-12): the image, its tiles, its EXIF; properties in `iprp` give the size and the rotation. All
lengths and counts are bounded before they are used; inconsistent files raise ValueError.
"""

from __future__ import annotations

import contextlib
import math
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, BinaryIO

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from shared.errors import Unprocessable
from shared.imaging.file_formats import (
    HEIC_MEDIA_TYPE,
    PHOTO_READ_ERRORS,
    PHOTO_SIGNATURE_BYTES,
    check_pixel_count,
    detect_media_type,
    open_photo,
)

MAX_META_BYTES = 4 * 1024 * 1024
MAX_EXIF_BYTES = 1024 * 1024
MAX_BOXES = 100_000
HEVC = (b"hvc1", b"grid")  # a single image, or a grid of tiles as phones write it
QUARTER_TURNS = 4


@dataclass(frozen=True, slots=True)
class _HeicHeader:
    """Size and EXIF of a HEIC photo."""

    width: int
    """pixels, upright"""
    height: int
    exif: bytes | None
    """TIFF block for Pillow's `Exif.load`."""


@dataclass(frozen=True, slots=True)
class _Box:
    name: bytes
    content: bytes


def _read_heic_header(file: BinaryIO) -> _HeicHeader:
    """Read size and EXIF of the primary image.

    Raises ValueError if there is none, or if it is not HEVC (AVIF, for example).
    """
    boxes = {box.name: box.content for box in _boxes(_meta(file))}
    primary = _primary(boxes[b"pitm"])
    kinds = dict(_kinds(boxes[b"iinf"]))
    if kinds.get(primary) not in HEVC:
        raise ValueError("the primary picture is not HEVC")
    width, height = _upright_size(boxes[b"iprp"], primary)
    exif_item = next((item for item, kind in kinds.items() if kind == b"Exif"), None)
    exif = None if exif_item is None else _exif(file, boxes.get(b"iloc", b""), exif_item)
    return _HeicHeader(width, height, exif)


def _meta(file: BinaryIO) -> bytes:
    """Return the content of the top-level box `meta`."""
    offset = 0
    for _ in range(MAX_BOXES):
        file.seek(offset)
        head = file.read(16)
        if len(head) < 8:
            break
        size, name = struct.unpack(">I4s", head[:8])
        begin = 8
        if size == 1 and len(head) == 16:
            size, begin = struct.unpack(">Q", head[8:])[0], 16
        if name == b"meta":
            if not begin + 4 <= size <= MAX_META_BYTES:
                raise ValueError("the box meta is too large")
            file.seek(offset + begin + 4)  # version and flags
            return _read_exactly(file, size - begin - 4)
        if size < begin:
            break  # 0: last box; otherwise broken
        offset += size
    raise ValueError("there is no box meta")


def _boxes(data: bytes) -> Iterator[_Box]:
    offset = 0
    while offset + 8 <= len(data):
        size, name = struct.unpack_from(">I4s", data, offset)
        if size < 8 or offset + size > len(data):
            raise ValueError(f"the box {name!r} has a wrong length")
        yield _Box(name, data[offset + 8 : offset + size])
        offset += size


def _primary(data: bytes) -> int:
    item: int = struct.unpack_from(">H" if data[0] == 0 else ">I", data, 4)[0]
    return item


def _kinds(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (item, item type) of each entry of `iinf`."""
    for box in _boxes(data[6 if data[0] == 0 else 8 :]):
        version = box.content[0]
        if box.name == b"infe" and version >= 2:
            item, _, kind = struct.unpack_from(">HH4s" if version == 2 else ">IH4s", box.content, 4)
            yield item, kind


def _upright_size(data: bytes, item: int) -> tuple[int, int]:
    """Return width and height of an item after rotation, from `ispe` and `irot`."""
    parts = {box.name: box.content for box in _boxes(data)}
    properties = list(_boxes(parts[b"ipco"]))
    size: tuple[int, int] | None = None
    quarter_turns = 0
    for index in _properties_of(parts[b"ipma"], item):
        if not 1 <= index <= len(properties):
            raise ValueError("a property is missing")
        box = properties[index - 1]
        if box.name == b"ispe":
            width, height = struct.unpack_from(">II", box.content, 4)
            size = (width, height)
        elif box.name == b"irot":
            quarter_turns += box.content[0] % QUARTER_TURNS
    if size is None or 0 in size:
        raise ValueError("the picture has no size")
    return size if quarter_turns % 2 == 0 else (size[1], size[0])


def _properties_of(data: bytes, item: int) -> Iterator[int]:
    """Yield an item's property numbers, from 1, by `ipma`; 0 stands for none."""
    version, wide = data[0], data[3] & 1
    (entries,) = struct.unpack_from(">I", data, 4)
    offset = 8
    for _ in range(min(entries, MAX_BOXES)):
        entry, count = struct.unpack_from(">HB" if version == 0 else ">IB", data, offset)
        offset += 3 if version == 0 else 5
        if entry == item:
            for number in range(count):
                if wide:
                    index = struct.unpack_from(">H", data, offset + 2 * number)[0] & 0x7FFF
                else:
                    index = data[offset + number] & 0x7F
                if index:
                    yield index
        offset += count * (2 if wide else 1)


def _exif(file: BinaryIO, data: bytes, item: int) -> bytes | None:
    """Return the TIFF block of the EXIF item; None unless it is one extent of this file."""
    extent = _extent(data, item)
    if extent is None or not 4 < extent[1] <= MAX_EXIF_BYTES:
        return None
    file.seek(extent[0])
    block = file.read(extent[1])
    if len(block) < 4:
        return None
    begin = 4 + struct.unpack_from(">I", block)[0]
    return block[begin:] or None


def _extent(data: bytes, item: int) -> tuple[int, int] | None:
    """Return (offset, length) of an item in the file, by `iloc`."""
    if len(data) < 8:
        return None
    version = data[0]
    offset_size, length_size = data[4] >> 4, data[4] & 15
    base_size, index_size = data[5] >> 4, data[5] & 15 if version else 0
    wide = version == 2
    (entries,) = struct.unpack_from(">I" if wide else ">H", data, 6)
    position = 10 if wide else 8

    def number(size: int) -> int:
        nonlocal position
        if position + size > len(data):
            raise ValueError("the box iloc is cut off")
        value = int.from_bytes(data[position : position + size], "big")
        position += size
        return value

    for _ in range(min(entries, MAX_BOXES)):
        entry = number(4 if wide else 2)
        method = number(2) & 15 if version else 0
        source, base, extents = number(2), number(base_size), number(2)
        extent = None
        for _ in range(extents):
            number(index_size)
            extent = base + number(offset_size), number(length_size)
        if entry == item:
            return extent if method == 0 and source == 0 and extents == 1 else None
    return None


def _read_exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise ValueError("the file is cut off")
    return data


ROTATED_ORIENTATIONS = (5, 6, 7, 8)  # EXIF orientations that swap width and height


@dataclass(frozen=True, slots=True)
class PhotoHeader:
    """Size, location and capture time of a photo; None for unknown values."""

    width: int
    """pixels, upright"""
    height: int
    latitude: float | None = None
    """degrees, WGS 84"""
    longitude: float | None = None
    heading: float | None = None
    """degrees clockwise from north, in [0, 360)"""
    captured_at: datetime | None = None
    """UTC; if `time_zone_is_known` is False, the camera's clock as if it were UTC"""
    time_zone_is_known: bool = False
    camera: str | None = None
    """make, model and serial number"""


def read_photo_header(file: BinaryIO, max_pixels: int) -> PhotoHeader:
    """Read a photo's header from its beginning.

    Raises Unprocessable: `undecodable_photo`, `too_many_pixels`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about unusual EXIF, which does not affect the pixels
            begin = file.read(PHOTO_SIGNATURE_BYTES)
            file.seek(0)
            if detect_media_type(begin) == HEIC_MEDIA_TYPE:
                return _heic_header(file, max_pixels)
            with open_photo(file) as image:
                check_pixel_count(image.width, image.height, max_pixels)
                return _header(image)
    except PHOTO_READ_ERRORS as error:
        raise Unprocessable(
            "undecodable_photo", "The photo can't be decoded: its header is damaged."
        ) from error


def _header(image: Image.Image) -> PhotoHeader:
    width, height = image.size
    exif = _exif_of_photo_header(image)
    # Pillow returns the upright size of a TIFF, but the stored size of all other formats.
    if image.format != "TIFF" and _orientation(exif) in ROTATED_ORIENTATIONS:
        width, height = height, width
    return _with_exif(width, height, exif)


def _heic_header(file: BinaryIO, max_pixels: int) -> PhotoHeader:
    """Read a HEIC header; the boxes have the size, and EXIF's orientation is ignored in HEIC."""
    header = _read_heic_header(file)
    check_pixel_count(header.width, header.height, max_pixels)
    exif = Image.Exif()
    if header.exif:
        with contextlib.suppress(*PHOTO_READ_ERRORS):
            exif.load(header.exif)
    return _with_exif(header.width, header.height, exif)


def _with_exif(width: int, height: int, exif: Image.Exif) -> PhotoHeader:
    gps = _directory(exif, IFD.GPSInfo)
    latitude = _degrees(gps.get(GPS.GPSLatitude), gps.get(GPS.GPSLatitudeRef), "NS", limit=90)
    longitude = _degrees(gps.get(GPS.GPSLongitude), gps.get(GPS.GPSLongitudeRef), "EW", limit=180)
    if latitude is None or longitude is None:
        latitude = longitude = None
    heading = _number(gps.get(GPS.GPSImgDirection))
    details = _directory(exif, IFD.Exif)
    gps_time = _gps_time(gps)
    clock, time_zone_is_known = _clock_time(details)
    return PhotoHeader(
        width=width,
        height=height,
        latitude=latitude,
        longitude=longitude,
        heading=heading % 360 if heading is not None else None,
        captured_at=gps_time or clock,
        time_zone_is_known=gps_time is not None or time_zone_is_known,
        camera=_camera(exif, details),
    )


def _exif_of_photo_header(image: Image.Image) -> Image.Exif:
    """Return the EXIF; for PNG only if it precedes the pixels, which are not decoded here."""
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
    """Return one of EXIF's sub-directories; empty if it is broken."""
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


def _camera(exif: Image.Exif, details: dict[int, Any]) -> str | None:
    try:
        texts = [exif.get(Base.Make), exif.get(Base.Model), details.get(Base.BodySerialNumber)]
    except PHOTO_READ_ERRORS:
        return None
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
