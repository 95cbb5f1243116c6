"""Descriptors that need no network: what a data set must not be solvable with.

Where one of these finds places, colour or layout gives them away, and a good figure of a real
descriptor on that data set says little.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from PIL import Image

COLOUR_BINS = 8
"""per channel"""
THUMBNAIL_PIXELS = 16
"""pixels each way"""

Rows = NDArray[np.float32]


def average_colour(photo: Image.Image) -> Rows:
    """(4,) the mean colour, as a unit vector: cosine orders it as distance in colour does.

    Three numbers near each other hardly differ in angle, so that they are lifted: x -> (x, 1 -
    |x|^2 / 2) turns small distances into angles.
    """
    mean = np.asarray(photo.resize((1, 1), Image.Resampling.BOX), np.float32).ravel() / 255
    return _unit(np.append(mean - 0.5, 1.0).astype(np.float32))


def colour_histogram(photo: Image.Image) -> Rows:
    """(BINS ** 3,) joint histogram, square roots taken: their cosine is Bhattacharyya's."""
    levels = np.asarray(photo, np.int32) * COLOUR_BINS // 256
    cells = (levels[..., 0] * COLOUR_BINS + levels[..., 1]) * COLOUR_BINS + levels[..., 2]
    return _unit(np.sqrt(np.bincount(cells.ravel(), minlength=COLOUR_BINS**3)).astype(np.float32))


def thumbnail(photo: Image.Image) -> Rows:
    """(THUMBNAIL ** 2,) grey pixels less their mean: the cosine is normalised correlation."""
    small = photo.convert("L").resize((THUMBNAIL_PIXELS, THUMBNAIL_PIXELS), Image.Resampling.BOX)
    pixels = np.asarray(small, np.float32).ravel()
    return _unit(pixels - pixels.mean())


BASELINE_DESCRIPTORS: dict[str, Callable[[Image.Image], Rows]] = {
    "average colour": average_colour,
    "colour histogram": colour_histogram,
    "thumbnail 16x16": thumbnail,
}


def _unit(row: Rows) -> Rows:
    norm = np.linalg.norm(row)
    return row / norm if norm > 0 else row
