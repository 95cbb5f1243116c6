"""The fast decoder of training photos, of which thousands a minute are decoded to a small size.

It decodes a JPEG at the smallest eighth that still covers the requested size (`Image.draft`), which
costs a fraction and differs from a full decode by less than one augmentation does.
"""

from __future__ import annotations

import warnings
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from shared.errors import Unprocessable
from shared.imaging.decode import apply_exif_orientation, is_sideways, to_rgb
from shared.imaging.file_formats import ACCEPTED_PHOTOS, PHOTO_READ_ERRORS, check_pixel_count
from shared.imaging.file_structure import open_photo

MAX_TRAINING_PIXELS = 100_000_000


def decode_resized(
    path: Path,
    size: tuple[int, int],
    *,
    resampling: Image.Resampling = Image.Resampling.BILINEAR,
) -> Image.Image:
    """Decode a photo to upright RGB of `size` (height, width), ignoring the aspect ratio.

    The resize is antialiased.

    Raises:
        Unprocessable: `undecodable_photo`, `too_many_pixels`; the message has the reason but not
            the path.
    """
    height, width = size
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # about unusual tags, which do not affect the pixels
            with open_photo(file) as image:
                check_pixel_count(image.width, image.height, MAX_TRAINING_PIXELS)
                image.draft("RGB", (height, width) if is_sideways(image) else (width, height))
                image.load()
                upright = apply_exif_orientation(image, to_rgb(image))
            return upright.resize((width, height), resampling)
    except UnidentifiedImageError as error:
        raise Unprocessable(
            "undecodable_photo", f"it is not {ACCEPTED_PHOTOS}, or its header is damaged"
        ) from error
    except PHOTO_READ_ERRORS as error:
        raise Unprocessable("undecodable_photo", f"{error or type(error).__name__}") from error
