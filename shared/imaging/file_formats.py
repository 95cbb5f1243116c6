"""File formats of photos: detection by content, limits by the header."""

from __future__ import annotations

import struct
from enum import StrEnum
from pathlib import PurePosixPath

from PIL import Image

from shared.errors import Unprocessable

# Pillow opens MPO (a JPEG followed by a second picture, which many phones write as .jpg) as JPEG;
# listing MPO here raises KeyError for all other formats.
PILLOW_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")
ACCEPTED_PHOTOS = "JPEG, PNG, WebP, BMP, TIFF or HEIC"
HEIC_MEDIA_TYPE = "image/heic"
# Major brands of HEVC images; `mif1` may contain other codecs, which the header shows.
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"mif1")
# Raised by Pillow for damaged photos and EXIF; UnidentifiedImageError is an OSError.
PHOTO_READ_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    EOFError,
    struct.error,
)
# Suffixes searched for in folders and archives; the format is detected from the content.
PHOTO_SUFFIXES = {
    *(".jpg", ".jpeg", ".jpe", ".jfif"),
    *(".png", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif"),
}
PHOTO_SIGNATURE_BYTES = 16  # enough to detect every accepted format
ARCHIVE_SIGNATURES = (b"PK\x03\x04", b"\x1f\x8b\x08")  # zip, gzip

# Disabled: check_pixel_count checks our own limit before anything is decoded.
Image.MAX_IMAGE_PIXELS = None


def photo_suffix(filename: str) -> str:
    """Return the lower-case ending of a photo's file name, `.jpg`; empty if it is no photo's."""
    suffix = PurePosixPath(filename).suffix.lower()
    return suffix if suffix in PHOTO_SUFFIXES else ""


def detect_media_type(first_bytes: bytes) -> str | None:
    """Detect the media type from the first PHOTO_SIGNATURE_BYTES; None if not accepted."""
    if first_bytes.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    if first_bytes.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    if first_bytes[:4] == b"RIFF" and first_bytes[8:12] == b"WEBP":
        return "image/webp"
    if first_bytes.startswith((b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")):
        return "image/tiff"
    # Texts may begin with "BM", too; a bitmap also has two reserved fields that are zero.
    if first_bytes.startswith(b"BM") and first_bytes[6:10] == b"\x00\x00\x00\x00":
        return "image/bmp"
    if first_bytes[4:8] == b"ftyp" and first_bytes[8:12] in HEIC_BRANDS:
        return HEIC_MEDIA_TYPE
    return None


# The longer side of a preview. Larger screens scale it up, which a photo of a place survives.
PREVIEW_PIXELS = 1600
# Formats that all browsers show.
BROWSER_MEDIA_TYPES = ("image/jpeg", "image/png", "image/webp")


class Previews(StrEnum):
    """The photos that previews are made of."""

    NONE = "none"
    OTHER_FORMATS = "other_formats"  # those that not all browsers show
    ALL = "all"  # and large ones (`needs_preview`)


def needs_preview(
    media_type: str | None, width: int, height: int, previews: Previews = Previews.ALL
) -> bool:
    """Return whether browsers need a preview because the photo is large, or of another format."""
    if media_type not in BROWSER_MEDIA_TYPES:
        return previews != Previews.NONE
    return previews == Previews.ALL and max(width, height) > PREVIEW_PIXELS


def check_pixel_count(width: int, height: int, max_pixels: int) -> None:
    """Raise Unprocessable (`too_many_pixels`) if width x height exceeds `max_pixels`."""
    if width * height > max_pixels:
        raise Unprocessable(
            "too_many_pixels",
            f"The photo has {width} x {height} pixels, {width * height / 1e6:.4g} megapixels; the "
            f"limit of this server is {max_pixels / 1e6:.4g} megapixels. Its administrator can "
            "raise the limit: MAX_IMAGE_PIXELS in the environment of the server, or in the file "
            ".env of the folder where it starts.",
        )
