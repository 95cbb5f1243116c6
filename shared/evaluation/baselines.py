"""Weak baseline descriptors without a network: mean colour, colour histogram, thumbnail.

A data set on which one of these recognises places can be solved by colour or layout alone. A good
recall of a real descriptor on such a data set has little meaning.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from PIL import Image

COLOUR_BINS = 8
"""bins per channel"""
THUMBNAIL_PIXELS = 16
"""side of the thumbnail"""

Rows = NDArray[np.float32]


def average_colour(photo: Image.Image) -> Rows:
    """Return the mean colour as a unit vector, (4,) float32.

    The centred colour gets a constant fourth component before normalisation, so that the cosine
    orders photos as the distance of their colours does.
    """
    mean = np.asarray(photo.resize((1, 1), Image.Resampling.BOX), np.float32).ravel() / 255
    return _unit(np.append(mean - 0.5, 1.0).astype(np.float32))


def _colour_histogram(photo: Image.Image) -> Rows:
    """Return the square roots of the joint colour histogram, (COLOUR_BINS ** 3,) float32.

    The cosine of two such vectors is the Bhattacharyya coefficient.
    """
    levels = np.asarray(photo, np.int32) * COLOUR_BINS // 256
    cells = (levels[..., 0] * COLOUR_BINS + levels[..., 1]) * COLOUR_BINS + levels[..., 2]
    return _unit(np.sqrt(np.bincount(cells.ravel(), minlength=COLOUR_BINS**3)).astype(np.float32))


def thumbnail(photo: Image.Image) -> Rows:
    """Return the mean-free grey pixels of a thumbnail, (THUMBNAIL_PIXELS ** 2,) float32.

    The cosine of two such vectors is the normalised cross-correlation.
    """
    small = photo.convert("L").resize((THUMBNAIL_PIXELS, THUMBNAIL_PIXELS), Image.Resampling.BOX)
    pixels = np.asarray(small, np.float32).ravel()
    return _unit(pixels - pixels.mean())


BASELINE_DESCRIPTORS: dict[str, Callable[[Image.Image], Rows]] = {
    "average colour": average_colour,
    "colour histogram": _colour_histogram,
    "thumbnail 16x16": thumbnail,
}


def _unit(row: Rows) -> Rows:
    norm = np.linalg.norm(row)
    return row / norm if norm > 0 else row
