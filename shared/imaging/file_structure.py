"""Size, EXIF and XMP of a photo, found by the structure of its file.

Pillow reads headers at a cost that the file decides: it joins EXIF segments one by one and unpacks
each of a PNG's colour profiles, which takes minutes for some megabytes. Here every segment, chunk
and box is a step of a `BoundedReader`, and Pillow opens only files that were read so
(`open_photo`).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from operator import index
from typing import BinaryIO

from PIL import Image
from PIL.ExifTags import Base

from shared.imaging.bounded_reader import MAX_METADATA_BYTES, MAX_OFFSET, BoundedReader
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
MAX_EXIF_SEGMENTS = 17  # of a JPEG: MAX_METADATA_BYTES in parts of 64 KiB
MAX_BLOCKS = 4  # of EXIF, and as many of XMP; the standards allow one
MAX_PICTURE_PARTS = 20_000
EXIF_PREFIX = b"Exif\0\0"
JPEG_XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
TIFF_HEADERS = (b"II*\0", b"MM\0*")
PNG_XMP = b"XML:com.adobe.xmp"
# ImageMagick's: hexadecimal digits after a line with their number.
PNG_PROFILES = {b"Raw profile type " + name for name in (b"exif", b"APP1", b"xmp")}
PNG_TEXTS = (b"tEXt", b"zTXt", b"iTXt")
MAX_KEYWORD_BYTES = 80
TIFF_XMP_TAG = 700
TIFF_PARTS = ((273, 279), (324, 325))  # offsets and lengths of strips, and of tiles
START_OF_SCAN = 0xDA
STARTS_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Frames, tables, the interval of restarts and Adobe's colour transform.
JPEG_PICTURE = {*range(0xC0, 0xD0), 0xDB, 0xDD, 0xEE}
FILL = (b"", b"\0", b"\xff")  # after 0xFF: no marker
WITHOUT_LENGTH = frozenset(range(0xD0, 0xDA))  # restarts, begin and end of the picture
BMP_INFO_SIZES = (40, 52, 56, 64, 108, 124)
WEBP_PICTURE = (b"VP8 ", b"VP8L", b"ALPH", b"ANIM", b"ANMF")


@dataclass(slots=True)
class Metadata:
    """The EXIF and XMP of a photo, as far as they were read."""

    exif: list[TiffBlock] = field(default_factory=list)
    """of one or several segments; of equal tags the last counts"""
    xmp: list[bytes] = field(default_factory=list)
    unread: str | None = None
    """why some of it was not read"""

    def add_exif(self, reader: BoundedReader, block: bytes | None) -> None:
        """Add EXIF with or without its prefix; None for a block that could not be read."""
        try:
            if block is None or len(self.exif) == MAX_BLOCKS:
                raise ValueError("its EXIF is damaged, or larger than 1 MB")
            if block := block.removeprefix(EXIF_PREFIX):
                self.exif.append(TiffBlock(reader.of_part(block)))
        except ValueError as error:
            self.unread = str(error)

    def add_xmp(self, packet: bytes | None) -> None:
        """Add a packet; None for one that could not be read."""
        if packet is None or len(self.xmp) == MAX_BLOCKS:
            self.unread = "its XMP is damaged, or larger than 1 MB"
        else:
            self.xmp.append(packet)


@dataclass(frozen=True, slots=True)
class PhotoStructure:
    """Size and metadata of a photo."""

    width: int
    """pixels"""
    height: int
    metadata: Metadata = field(default_factory=Metadata)
    is_upright: bool = False
    """The size is that of the upright photo, and the orientation in its EXIF has no meaning."""
    picture: Sequence[tuple[int, int]] = ()
    """(offset, length) of the parts of the file that hold the picture without metadata; the last
    may end behind the file. Empty if they are unknown."""


def read_structure(file: BinaryIO) -> PhotoStructure:
    """Read size and metadata of a photo, at a cost that is bounded (`BoundedReader`).

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
    image = Image.open(file, formats=PILLOW_FORMATS)
    for xmp in ("xmp", "XML:com.adobe.xmp"):
        image.info.pop(xmp, None)  # by which Pillow would turn the photo; browsers do not
    return image


def _read_jpeg(reader: BoundedReader) -> PhotoStructure:
    width = height = 0
    exif: list[bytes] = []
    metadata = Metadata()
    picture: list[tuple[int, int]] = []
    exif_segments = 0
    for marker, offset, size in _jpeg_segments(reader):
        if marker in STARTS_OF_FRAME:
            height, width = struct.unpack(">HH", reader.read(offset + 1, 4))
        if marker == START_OF_SCAN:
            picture.append((offset, MAX_OFFSET))
        elif marker in JPEG_PICTURE:
            picture.append((offset, size))
        elif marker == 0xE1:
            content = reader.read(offset, size)
            if content.startswith(EXIF_PREFIX):
                block = content.removeprefix(EXIF_PREFIX)
                if block.startswith(TIFF_HEADERS) or not exif:
                    exif.append(block)
                else:
                    exif[-1] += block  # the rest of a TIFF that is larger than a segment
                exif_segments += 1
                if exif_segments > MAX_EXIF_SEGMENTS:
                    raise ValueError(f"it has more than {MAX_EXIF_SEGMENTS} EXIF segments")
            elif content.startswith(JPEG_XMP_PREFIX):
                metadata.add_xmp(content.removeprefix(JPEG_XMP_PREFIX))
    for block in exif:
        metadata.add_exif(reader, block)
    is_whole = bool(picture) and picture[-1][1] == MAX_OFFSET
    return PhotoStructure(width, height, metadata, picture=picture if is_whole else ())


def _jpeg_segments(reader: BoundedReader) -> Iterator[tuple[int, int, int]]:
    """Yield marker, offset and size of the segments up to the first with pixels (size 0)."""
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
            yield marker, offset, 0
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
    metadata = Metadata()
    picture = [(16, 17)]
    has_pixels = False
    offset = 33
    for number in count():
        if number == MAX_SEGMENTS and not has_pixels:
            raise ValueError(f"it has more than {MAX_SEGMENTS} chunks before its pixels")
        try:
            size, kind = struct.unpack(">I4s", reader.read(offset, 8))
            if kind == b"eXIf":
                content = reader.read(offset + 8, size) if size <= MAX_METADATA_BYTES else None
                metadata.add_exif(reader, content)
            elif kind in PNG_TEXTS:
                _read_png_text(reader, metadata, kind, offset + 8, size)
        except ValueError as error:
            if not has_pixels:
                raise
            metadata.unread = str(error)  # whether the pixels are whole, the decoder reports
            break
        if kind == b"IEND":
            break
        if kind in (b"PLTE", b"tRNS", b"IDAT"):
            has_pixels |= kind == b"IDAT"
            picture.append((offset + 8, size))
        offset += 12 + size
    return PhotoStructure(width, height, metadata, picture=picture if has_pixels else ())


def _read_png_text(
    reader: BoundedReader, metadata: Metadata, kind: bytes, offset: int, size: int
) -> None:
    """Add EXIF or XMP of a chunk of text, if its keyword says that it is one."""
    keyword = reader.read(offset, min(size, MAX_KEYWORD_BYTES)).partition(b"\0")[0]
    if keyword != PNG_XMP and keyword not in PNG_PROFILES:
        return
    text = None
    if size <= MAX_METADATA_BYTES and len(metadata.xmp) + len(metadata.exif) < 2 * MAX_BLOCKS:
        text = _png_text(kind, reader.read(offset, size)[len(keyword) + 1 :])
    if keyword == PNG_XMP:
        metadata.add_xmp(text)
        return
    try:
        profile = text and bytes.fromhex(text.split(None, 2)[2].decode("ascii"))
    except (ValueError, LookupError):
        profile = None
    if profile is not None and profile.startswith((JPEG_XMP_PREFIX, b"<")):
        metadata.add_xmp(profile.removeprefix(JPEG_XMP_PREFIX))
    else:
        metadata.add_exif(reader, profile)


def _png_text(kind: bytes, content: bytes) -> bytes | None:
    """Return the text of a chunk after its keyword; None if it is too large or broken."""
    if kind == b"tEXt":
        return content
    if kind == b"iTXt":
        texts = content[2:].split(b"\0", 2)  # language, translated keyword, text
        if len(texts) < 3 or not content[0]:
            return texts[-1] if len(texts) == 3 else None
        content = b"\0" + texts[2]
    unpacker = zlib.decompressobj()
    try:
        text = unpacker.decompress(content[1:], MAX_METADATA_BYTES)
    except zlib.error:
        return None
    return text if unpacker.eof else None


def _read_webp(reader: BoundedReader) -> PhotoStructure:
    (size,) = struct.unpack("<I", reader.read(4, 4))
    kind, content = reader.read(12, 4), reader.read_available(20, 10)
    if kind == b"VP8 ":
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", content, 6))
    elif kind == b"VP8L":
        bits = int.from_bytes(content[1:5], "little")
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    elif kind == b"VP8X":
        width, height = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (4, 7))
    else:
        raise ValueError("its header does not begin with the size")
    metadata = Metadata()
    picture = []
    offset, end = 12, 8 + size
    while offset + 8 <= end:
        head = reader.read_available(offset, 8)
        if len(head) < 8:
            metadata.unread = "the file is cut off"
            break
        kind, length = struct.unpack("<4sI", head)
        if kind in (b"EXIF", b"XMP "):
            block = reader.read(offset + 8, length) if length <= MAX_METADATA_BYTES else None
            if kind == b"EXIF":
                metadata.add_exif(reader, block)
            else:
                metadata.add_xmp(block)
        elif kind in WEBP_PICTURE:
            picture.append((offset + 8, length))
        offset += 8 + length + length % 2
    return PhotoStructure(width, height, metadata, picture=picture)


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
    metadata = Metadata([tiff])
    if TIFF_XMP_TAG in tiff.read_directory(tiff.first_offset, (TIFF_XMP_TAG,)):
        metadata.add_xmp(tiff.read_bytes(tiff.first_offset, TIFF_XMP_TAG, MAX_METADATA_BYTES))
    # A size that is no integer raises TypeError.
    width, height = index(size[Base.ImageWidth]), index(size[Base.ImageLength])
    return PhotoStructure(width, height, metadata, picture=_tiff_picture(tiff))


def _tiff_picture(tiff: TiffBlock) -> Sequence[tuple[int, int]]:
    """Return the strips or tiles of a TIFF with one picture."""
    tags = [tag for pair in TIFF_PARTS for tag in pair]
    found = tiff.read_directory(tiff.first_offset, tags, MAX_METADATA_BYTES)
    columns = [
        value if isinstance(value, tuple) else (value,)
        for value in (found.get(tag) for tag in tags)
        if isinstance(value, int | tuple)
    ]
    if len(columns) != 2 or len(columns[0]) > MAX_PICTURE_PARTS:
        return ()
    try:
        several = tiff.has_next_directory(tiff.first_offset)
    except ValueError:
        return ()
    return () if several else list(zip(*columns, strict=False))


def _read_heic(reader: BoundedReader) -> PhotoStructure:
    heic = read_heic(reader)
    metadata = Metadata()
    for block in heic.exif:
        metadata.add_exif(reader, block)
    for packet in heic.xmp:
        metadata.add_xmp(packet)
    return PhotoStructure(heic.width, heic.height, metadata, True, heic.picture)


READERS: dict[str, Callable[[BoundedReader], PhotoStructure]] = {
    "image/jpeg": _read_jpeg,
    "image/png": _read_png,
    "image/webp": _read_webp,
    "image/bmp": _read_bmp,
    "image/tiff": _read_tiff,
    HEIC_MEDIA_TYPE: _read_heic,
}
