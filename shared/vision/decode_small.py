"""A photo decoded for a network that sees it small, as training does thousands of times a minute.

A JPEG is decoded at the smallest of its eighths that still covers the wanted size (`Image.draft`):
a large photo costs a fraction, and differs from a full decoding by less than one augmentation does.
Imports no torch.
"""

from __future__ import annotations

import warnings
from pathlib import Path

from PIL import Image, UnidentifiedImageError
from PIL.ExifTags import Base

from shared.errors import Unprocessable
from shared.photo_formats import ACCEPTED_PHOTOS, PHOTO_READ_ERRORS, check_pixel_count, open_photo
from shared.vision.decode import apply_exif_orientation, to_rgb

SIDEWAYS_ORIENTATIONS = (5, 6, 7, 8)
"""EXIF orientations whose upright photo is as wide as the stored one is high"""
MAX_TRAINING_PIXELS = 100_000_000


def decode_resized(
    path: Path, size: tuple[int, int], max_pixels: int = MAX_TRAINING_PIXELS
) -> Image.Image:
    """The photo in RGB, upright, squeezed to `size` (height, width) by antialiased bilinear.

    Raises Unprocessable (`undecodable_photo`, `too_many_pixels`), which says why, not which.
    """
    height, width = size
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # a strange tag is no reason to refuse the pixels
            with open_photo(file) as image:
                check_pixel_count(image.width, image.height, max_pixels)
                image.draft("RGB", (height, width) if _is_sideways(image) else (width, height))
                image.load()
                upright = apply_exif_orientation(image, to_rgb(image))
            return upright.resize((width, height), Image.Resampling.BILINEAR)
    except UnidentifiedImageError as error:
        raise Unprocessable(
            "undecodable_photo", f"it is not {ACCEPTED_PHOTOS}, or its header is damaged"
        ) from error
    except PHOTO_READ_ERRORS as error:
        raise Unprocessable("undecodable_photo", f"{error or type(error).__name__}") from error


def _is_sideways(image: Image.Image) -> bool:
    try:
        return image.getexif().get(Base.Orientation) in SIDEWAYS_ORIENTATIONS
    except PHOTO_READ_ERRORS:
        return False  # broken EXIF is no reason to refuse the pixels
