"""Decoding of untrusted photos to RGB pixels, upright or as stored.

`decode_photo` runs in child processes with a memory limit (`services.extractor.decoder_pool`), so
that a malicious photo only fails its own job.

Imports no torch.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from PIL import __version__ as pillow_version
from PIL.ExifTags import Base

from shared.errors import Unprocessable
from shared.imaging.file_formats import (
    ACCEPTED_PHOTOS,
    HEIC_MEDIA_TYPE,
    PHOTO_READ_ERRORS,
    PHOTO_SIGNATURE_BYTES,
    PREVIEW_PIXELS,
    Previews,
    check_pixel_count,
    detect_media_type,
    needs_preview,
)
from shared.imaging.file_structure import open_photo
from shared.imaging.photo_header import ROTATED_ORIENTATIONS
from shared.imaging.preprocessing import Pixels, Preprocessing
from shared.matching.features import WORKING_SIDE

# Larger JPEGs are decoded at half their size. The results of smaller ones stay as they always were.
FULL_DECODE_PIXELS = 50_000_000
THUMBNAIL_PIXELS = 256  # the longer side
DECODER = f"pillow-{pillow_version}"
EXIF_TRANSPOSITIONS = {  # by EXIF orientation; 1 is upright
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


@dataclass(frozen=True, slots=True)
class DecodedPhoto:
    """Preprocessed pixels, thumbnail and preview of a photo."""

    pixels: Pixels
    """(height, width, 3) RGB after preprocessing."""
    thumbnail: bytes
    """JPEG without any metadata, its longer side at most THUMBNAIL_PIXELS."""
    preview: bytes | None = None
    """The same with PREVIEW_PIXELS; None if not requested, or if the photo needs none
    (`shared.imaging.file_formats.needs_preview`)."""
    size: tuple[int, int] = (0, 0)
    """(width, height) of the upright photo."""
    detection_pixels: NDArray[np.uint8] | None = None
    """(height, width, 1) mean of RGB of the upright photo, its longer side at most WORKING_SIDE;
    None if not requested"""


def decode_photo(
    data: bytes,
    preprocessing: Preprocessing,
    max_pixels: int,
    *,
    previews: Previews = Previews.NONE,
    for_detection: bool = False,
) -> DecodedPhoto:
    """Decode and preprocess a photo, and make what else `DecodedPhoto` has of it.

    Only the first frame is read. Transparent areas become black; 16-bit samples keep their upper
    eight bits. A JPEG of more than FULL_DECODE_PIXELS is decoded at half its width and height,
    which bounds the memory; no preprocessing needs as many pixels.

    Raises:
        Unprocessable: `undecodable_photo` with the decoder's reason, `too_many_pixels`,
            `photo_too_small`, `no_heic_decoder`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about unusual tags, which do not affect the pixels
            media_type = detect_media_type(data[:PHOTO_SIGNATURE_BYTES])
            with _open_image(data, media_type) as image:
                check_pixel_count(image.width, image.height, max_pixels)
                size = image.size
                with_preview = needs_preview(media_type, image.width, image.height, previews)
                if image.width * image.height > FULL_DECODE_PIXELS:
                    # None keeps the mode; other formats than JPEG ignore the call.
                    image.draft(None, (image.width // 2, image.height // 2))
                image.load()
                as_stored = to_rgb(image)
                upright = apply_exif_orientation(image, as_stored)
                if is_sideways(image):
                    size = size[::-1]
            pixels = preprocessing.apply(upright if preprocessing.upright else as_stored)
            thumbnail = _small_jpeg(upright, THUMBNAIL_PIXELS, quality=85)
            preview = _small_jpeg(upright, PREVIEW_PIXELS, quality=80) if with_preview else None
            small = None
            if for_detection:
                # One channel is shrunk in 2 ms, three in 5. Keypoints are found as well as in a
                # bicubic copy, in half its time.
                gray = upright.convert("L", (1 / 3, 1 / 3, 1 / 3, 0))
                working = _shrink(gray, WORKING_SIDE, Image.Resampling.BILINEAR)
                small = np.atleast_3d(np.asarray(working))
            return DecodedPhoto(pixels, thumbnail, preview, size, small)
    except UnidentifiedImageError as error:
        raise Unprocessable(
            "undecodable_photo",
            f"The photo can't be decoded: it is not {ACCEPTED_PHOTOS}, or its header is damaged.",
        ) from error
    except PHOTO_READ_ERRORS as error:
        raise Unprocessable(
            "undecodable_photo",
            f"The photo can't be decoded: {error or type(error).__name__}.",
        ) from error
    except MemoryError as error:
        raise Unprocessable(
            "undecodable_photo",
            "Decoding the photo needs more memory than the limit for one photo. "
            "Send a smaller photo, or a JPEG.",
        ) from error


def _open_image(data: bytes, media_type: str | None) -> Image.Image:
    if media_type != HEIC_MEDIA_TYPE:
        return open_photo(io.BytesIO(data))
    try:
        import pillow_heif  # optional: its wheels include libraries under other licences
    except ImportError as error:
        raise Unprocessable(
            "no_heic_decoder",
            "This server's extractor has no decoder for HEIC. Install the extra `heic` there "
            "(uv pip install '.[heic]' in the repository) and retry the job, or send the photo as "
            "JPEG.",
        ) from error
    pillow_heif.options.DECODE_THREADS = 1  # the pool has as many children as there are cores
    pillow_heif.register_heif_opener(thumbnails=False)
    return Image.open(io.BytesIO(data), formats=("HEIF",))


def apply_exif_orientation(image: Image.Image, rgb: Image.Image) -> Image.Image:
    """Transpose `rgb` by the EXIF orientation of `image`.

    Pillow's `exif_transpose` also rewrites the EXIF, and fails if any other tag is broken.
    """
    method = EXIF_TRANSPOSITIONS.get(_exif_orientation(image))
    return rgb if method is None else rgb.transpose(method)


def is_sideways(image: Image.Image) -> bool:
    """Whether the EXIF orientation of an image exchanges width and height."""
    return _exif_orientation(image) in ROTATED_ORIENTATIONS


def _exif_orientation(image: Image.Image) -> int:
    try:
        orientation = image.getexif().get(Base.Orientation)
    except PHOTO_READ_ERRORS:
        return 1  # broken EXIF does not affect the pixels
    return orientation if isinstance(orientation, int) else 1


def to_rgb(image: Image.Image) -> Image.Image:
    """Convert to 8-bit RGB on black; ValueError for modes without a defined brightness range."""
    if image.mode.startswith("I;16"):
        # Pillow would clip 16-bit samples at 255 and make the photo white.
        samples = np.asarray(image, dtype=np.uint16)
        return Image.fromarray((samples >> 8).astype(np.uint8)).convert("RGB")
    if image.mode in ("I", "F"):
        raise ValueError(f"samples of mode {image.mode!r} have no defined brightness range")
    if not image.has_transparency_data:
        return image if image.mode == "RGB" else image.convert("RGB")
    # The colour under full transparency depends on the program that wrote the file; mostly black.
    rgba = image.convert("RGBA")
    on_black = Image.new("RGB", image.size)
    on_black.paste(rgba, mask=rgba.getchannel("A"))
    return on_black


def _shrink(
    rgb: Image.Image,
    longer_side: int,
    resampling: Image.Resampling = Image.Resampling.BICUBIC,
) -> Image.Image:
    """Return a copy whose longer side has at most `longer_side` pixels."""
    scale = min(1.0, longer_side / max(rgb.size))
    size = max(1, round(rgb.width * scale)), max(1, round(rgb.height * scale))
    # Averaged over integer blocks first: a fraction of the time, no visible difference.
    return rgb.resize(size, resampling, reducing_gap=1.0)


def _small_jpeg(rgb: Image.Image, longer_side: int, *, quality: int) -> bytes:
    """Encode a copy whose longer side has at most `longer_side` pixels, without any metadata."""
    small = _shrink(rgb, longer_side)
    small.info.clear()  # removes the camera's metadata (location, time, owner)
    buffer = io.BytesIO()
    small.save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()
