"""Size, EXIF and XMP of a photo, found by the structure of its file.

Pillow reads headers at a cost that the file decides: it joins EXIF segments one by one and unpacks
each of a PNG's colour profiles, which takes minutes for some megabytes. Here every segment, chunk
and box is a step of a `BoundedReader`, and Pillow opens only files that were read so
(`open_photo`).
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import index
from typing import BinaryIO

from PIL import Image
from PIL.ExifTags import Base

from shared.imaging.bounded_reader import MAX_METADATA_BYTES, BoundedReader
from shared.imaging.exif import TiffBlock
from shared.imaging.file_formats import (
    ACCEPTED_PHOTOS,
    HEIC_MEDIA_TYPE,
    PHOTO_SIGNATURE_BYTES,
    PILLOW_FORMATS,
    detect_media_type,
)
from shared.imaging.heic import read_heic

# Of a JPEG or PNG before its pixels. Thermal cameras and panoramas, whose XMP contains photos,
# write up to some hundred segments.
MAX_SEGMENTS = 1000
MAX_EXIF_SEGMENTS = 4  # of a JPEG; the standard allows one
EXIF_PREFIX = b"Exif\0\0"
JPEG_XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
PNG_XMP_PREFIX = b"XML:com.adobe.xmp\0"
TIFF_XMP_TAG = 700
START_OF_SCAN = 0xDA
STARTS_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
FILL = (b"", b"\0", b"\xff")  # after 0xFF: no marker
WITHOUT_LENGTH = frozenset(range(0xD0, 0xDA))  # restarts, begin and end of the picture
BMP_INFO_SIZES = (40, 52, 56, 64, 108, 124)
WEBP_HAS_EXIF_OR_XMP = 0b1100


@dataclass(frozen=True, slots=True)
class PhotoStructure:
    """Size and metadata of a photo."""

    width: int
    """pixels"""
    height: int
    exif: TiffBlock | None = None
    xmp: bytes | None = None
    is_upright: bool = False
    """The size is that of the upright photo, and the orientation in its EXIF has no meaning."""


def read_structure(file: BinaryIO) -> PhotoStructure:
    """Read size and metadata of a photo, at a cost that is bounded (`BoundedReader`).

    EXIF that is not TIFF is left out, and so is EXIF of a PNG that follows the pixels.

    Raises:
        ValueError: The file is no photo, damaged, cut off, or has more parts than a photo; the
            message is the reason.
        OSError: The file can't be read.
    """
    reader = BoundedReader(file)
    media_type = detect_media_type(reader.read_available(0, PHOTO_SIGNATURE_BYTES))
    if media_type is None:
        raise ValueError(f"it is not {ACCEPTED_PHOTOS}")
    try:
        structure = READERS[media_type](reader)
    except (LookupError, TypeError, struct.error) as error:
        raise ValueError("its header is damaged") from error
    if structure.width <= 0 or structure.height <= 0:
        raise ValueError("its header has no size")
    return structure


def open_photo(file: BinaryIO) -> Image.Image:
    """Open a photo with Pillow; reads the header and decodes no pixels.

    Raises PHOTO_READ_ERRORS, also for structures that Pillow would read for minutes.
    """
    read_structure(file)
    file.seek(0)
    return Image.open(file, formats=PILLOW_FORMATS)


def _exif_block(block: bytes | None) -> TiffBlock | None:
    """Return EXIF with or without its prefix; None if it is missing or broken."""
    if not block:
        return None
    try:
        return TiffBlock(BoundedReader(io.BytesIO(block.removeprefix(EXIF_PREFIX))))
    except ValueError:
        return None


def _read_jpeg(reader: BoundedReader) -> PhotoStructure:
    width = height = 0
    exif: list[bytes] = []
    xmp = None
    for marker, offset, size in _jpeg_segments(reader):
        if marker in STARTS_OF_FRAME:
            height, width = struct.unpack(">HH", reader.read(offset + 1, 4))
        elif marker == 0xE1:
            content = reader.read(offset, size)
            if content.startswith(EXIF_PREFIX):
                exif.append(content.removeprefix(EXIF_PREFIX))
                if len(exif) > MAX_EXIF_SEGMENTS:
                    raise ValueError(f"it has more than {MAX_EXIF_SEGMENTS} EXIF segments")
            elif content.startswith(JPEG_XMP_PREFIX):
                xmp = content.removeprefix(JPEG_XMP_PREFIX)
    return PhotoStructure(width, height, _exif_block(b"".join(exif)), xmp)


def _jpeg_segments(reader: BoundedReader) -> Iterator[tuple[int, int, int]]:
    """Yield marker, offset and size of the segments before the pixels."""
    offset = 2
    for _ in range(MAX_SEGMENTS):
        while (two := reader.read_available(offset, 2))[:1] != b"\xff" or two[1:] in FILL:
            if len(two) < 2:
                reader.read(offset - 1, 1)  # raises if the segment before is cut off
                return  # only the pixels are missing, which the decoder reports
            offset += 1
        marker = two[1]
        offset += 2
        if marker == START_OF_SCAN:
            return
        if marker < 0xC0:
            raise ValueError("its header has an unknown marker")
        if marker in WITHOUT_LENGTH:
            continue
        (size,) = struct.unpack(">H", reader.read(offset, 2))
        if size < 2:
            raise ValueError("a segment of its header has a wrong length")
        yield marker, offset + 2, size - 2
        offset += size
    raise ValueError(f"it has more than {MAX_SEGMENTS} segments before its pixels")


def _read_png(reader: BoundedReader) -> PhotoStructure:
    kind, width, height = struct.unpack(">4x4sII", reader.read(8, 16))
    if kind != b"IHDR":
        raise ValueError("its header does not begin with the size")
    exif = xmp = None
    offset = 33
    for _ in range(MAX_SEGMENTS):
        size, kind = struct.unpack(">I4s", reader.read(offset, 8))
        if kind in (b"IDAT", b"IEND"):
            return PhotoStructure(width, height, _exif_block(exif), xmp)
        if kind in (b"eXIf", b"iTXt") and size <= MAX_METADATA_BYTES:
            content = reader.read(offset + 8, size)
            if kind == b"eXIf":
                exif = content
            elif content.startswith(PNG_XMP_PREFIX):
                xmp = _png_text(content.removeprefix(PNG_XMP_PREFIX))
        offset += 12 + size
    raise ValueError(f"it has more than {MAX_SEGMENTS} chunks before its pixels")


def _png_text(content: bytes) -> bytes | None:
    """Return the text of `iTXt` after its keyword; None if it is too large or broken."""
    texts = content[2:].split(b"\0", 2)  # language, translated keyword, text
    if len(texts) < 3:
        return None
    if not content[0]:
        return texts[2]
    unpacker = zlib.decompressobj()
    try:
        text = unpacker.decompress(texts[2], MAX_METADATA_BYTES)
    except zlib.error:
        return None
    return text if unpacker.eof else None


def _read_webp(reader: BoundedReader) -> PhotoStructure:
    (size,) = struct.unpack("<I", reader.read(4, 4))
    kind, content = reader.read(12, 4), reader.read_available(20, 10)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", content, 6)
        return PhotoStructure(width & 0x3FFF, height & 0x3FFF)
    if kind == b"VP8L":
        bits = int.from_bytes(content[1:5], "little")
        return PhotoStructure((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    if kind != b"VP8X":
        raise ValueError("its header does not begin with the size")
    width, height = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (4, 7))
    blocks: dict[bytes, bytes] = {}
    offset, end = 12, 8 + size if content[0] & WEBP_HAS_EXIF_OR_XMP else 0
    while offset + 8 <= end:
        kind, length = struct.unpack("<4sI", reader.read(offset, 8))
        if kind in (b"EXIF", b"XMP ") and length <= MAX_METADATA_BYTES:
            blocks.setdefault(kind, reader.read(offset + 8, length))
        offset += 8 + length + length % 2
    return PhotoStructure(width, height, _exif_block(blocks.get(b"EXIF")), blocks.get(b"XMP "))


def _read_bmp(reader: BoundedReader) -> PhotoStructure:
    (info_size,) = struct.unpack("<I", reader.read(14, 4))
    if info_size == 12:
        return PhotoStructure(*struct.unpack("<HH", reader.read(18, 4)))
    if info_size not in BMP_INFO_SIZES:
        raise ValueError(f"its header has an unknown size of {info_size} bytes")
    width, height = struct.unpack("<Ii", reader.read(18, 8))
    return PhotoStructure(width, abs(height))  # negative: the first row is the upper one


def _read_tiff(reader: BoundedReader) -> PhotoStructure:
    tiff = TiffBlock(reader)
    size = tiff.read_directory(tiff.first_offset, (Base.ImageWidth, Base.ImageLength))
    xmp = tiff.read_bytes(tiff.first_offset, TIFF_XMP_TAG, MAX_METADATA_BYTES)
    # A size that is no integer raises TypeError.
    return PhotoStructure(index(size[Base.ImageWidth]), index(size[Base.ImageLength]), tiff, xmp)


def _read_heic(reader: BoundedReader) -> PhotoStructure:
    width, height, exif = read_heic(reader)
    return PhotoStructure(width, height, _exif_block(exif), is_upright=True)


READERS: dict[str, Callable[[BoundedReader], PhotoStructure]] = {
    "image/jpeg": _read_jpeg,
    "image/png": _read_png,
    "image/webp": _read_webp,
    "image/bmp": _read_bmp,
    "image/tiff": _read_tiff,
    HEIC_MEDIA_TYPE: _read_heic,
}
