"""Photos that tests make: each number is another photo, the same on every run."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image


def photo_image(number: int, width: int = 64, height: int = 48) -> Image.Image:
    """Coarse random colours, so that two numbers are far apart for every extractor."""
    rng = np.random.default_rng(number)
    coarse = Image.fromarray(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8))
    return coarse.resize((width, height), Image.Resampling.NEAREST)


def photo_bytes(number: int, media: str = "JPEG", **options: Any) -> bytes:
    """The photo `number` as a file of the given Pillow format."""
    buffer = io.BytesIO()
    photo_image(number).save(buffer, media, **options)
    return buffer.getvalue()


def near_copy(number: int) -> bytes:
    """The photo `number` a little darker: other bytes, the same place."""
    buffer = io.BytesIO()
    darker = photo_image(number).point(lambda value: int(value * 0.9))
    darker.save(buffer, "JPEG", quality=80)
    return buffer.getvalue()
