"""Shares of patches as a picture that can be laid over the photo."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

# Told apart by every kind of sight.
POSITIVE_COLOUR = (230, 97, 1)  # orange: the patch speaks for the match
NEGATIVE_COLOUR = (94, 60, 153)  # violet: it speaks against it


def draw_overlay(shares: NDArray[np.float64]) -> tuple[str, float]:
    """(rows, columns) shares -> a PNG as a data URI, one pixel for each patch, and the full share.

    The colour says for or against, the opacity |share| / full share: where nothing is added, the
    picture is transparent. The full share is the strongest one of either sign; 0 if all are 0.
    """
    strength = np.abs(shares)
    full = float(strength.max())
    pixels = np.zeros((*shares.shape, 4), np.uint8)
    pixels[..., :3] = np.where((shares >= 0)[..., np.newaxis], POSITIVE_COLOUR, NEGATIVE_COLOUR)
    if full > 0:
        pixels[..., 3] = np.round(255 * strength / full)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}", full
