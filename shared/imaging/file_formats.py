"""Which archives are accepted: recognised by their first bytes, not by their names.

Which photos are accepted: recognised by their content, limited by their header.
"""

from __future__ import annotations

import struct
from enum import StrEnum
from typing import BinaryIO

from PIL import Image

from shared.errors import Unprocessable

ARCHIVE_SIGNATURE_BYTES = 512  # a tar's first header
ACCEPTED_ARCHIVES = "a zip, a tar or a gzipped tar"

TAR_CHECKSUM_FIELD = slice(
    148, 156
)  # of a tar's header: where the sum of its other bytes stands, in octal


class ArchiveFormat(StrEnum):
    ZIP = "zip"
    TAR = "tar"
    GZIP = "gzip"  # of a tar, one hopes: only unpacking tells


def detect_archive_format(first_bytes: bytes) -> ArchiveFormat | None:
    """The format by the first SNIFFED_ARCHIVE_BYTES; None for anything not accepted."""
    if first_bytes.startswith((b"PK\x03\x04", b"PK\x05\x06")):  # the second one: an empty zip
        return ArchiveFormat.ZIP
    if first_bytes.startswith(b"\x1f\x8b\x08"):
        return ArchiveFormat.GZIP
    return ArchiveFormat.TAR if is_tar_header(first_bytes[:ARCHIVE_SIGNATURE_BYTES]) else None


def is_tar_header(block: bytes) -> bool:
    """Is it a tar's header of 512 bytes, by its checksum? Not every tar has the word `ustar`."""
    if len(block) != ARCHIVE_SIGNATURE_BYTES:
        return False
    try:
        said = int(block[TAR_CHECKSUM_FIELD].strip(b"\0 ") or b"-1", 8)
    except ValueError:
        return False
    return said == sum(block) - sum(block[TAR_CHECKSUM_FIELD]) + 8 * ord(" ")


# MPO, which many phones write under the name JPEG (a JPEG with a second picture behind it), is
# opened by Pillow as JPEG: naming it here is a KeyError for everything but a JPEG.
PILLOW_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")
ACCEPTED_PHOTOS = "JPEG, PNG, WebP, BMP, TIFF or HEIC"
HEIC_MEDIA_TYPE = "image/heic"
# The first brand of files of HEVC pictures: `mif1` may hold others, which their header tells.
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"mif1")
# What Pillow raises for damaged photos and EXIF; UnidentifiedImageError is an OSError.
PHOTO_READ_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    EOFError,
    struct.error,
)
# Of files that are looked for in folders and archives; what they are is told by their content.
PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif"}
PHOTO_SIGNATURE_BYTES = 16  # enough to tell every accepted format

# Our own limit is checked from the header before anything is decoded.
Image.MAX_IMAGE_PIXELS = None


def detect_media_type(first_bytes: bytes) -> str | None:
    """The media type by the first SNIFFED_BYTES of a file; None for anything not accepted."""
    if first_bytes.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    if first_bytes.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    if first_bytes[:4] == b"RIFF" and first_bytes[8:12] == b"WEBP":
        return "image/webp"
    if first_bytes.startswith((b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")):
        return "image/tiff"
    # "BM" alone begins many texts: a bitmap has two reserved fields, which are zero.
    if first_bytes.startswith(b"BM") and first_bytes[6:10] == b"\x00\x00\x00\x00":
        return "image/bmp"
    if first_bytes[4:8] == b"ftyp" and first_bytes[8:12] in HEIC_BRANDS:
        return HEIC_MEDIA_TYPE
    return None


def open_photo(file: BinaryIO) -> Image.Image:
    """The photo with its header read and its pixels not yet decoded."""
    return Image.open(file, formats=PILLOW_FORMATS)


def check_pixel_count(width: int, height: int, max_pixels: int) -> None:
    """Unprocessable (`too_many_pixels`) when the header promises more than the limit."""
    if width * height > max_pixels:
        raise Unprocessable(
            "too_many_pixels",
            f"The photo has {width} x {height} pixels; "
            f"the limit is {max_pixels} in all (MAX_IMAGE_PIXELS).",
        )
