"""Background of a query: what the photos of one ride have in common is no sign of the place.

Snow, rain, the light of street lamps and the camera itself shift all descriptors of a ride alike,
by more than places differ. Subtracting the mean of the ride's descriptors from the query's removes
the shift (standardisation of the features of each condition: Schubert, Neubert and Protzel 2020,
"Unsupervised learning methods for visual place recognition in discretely and continuously changing
environments").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

PRIOR_ROWS = 8
"""The mean is shrunk towards 0 as by so many rows of zeros: the first frames say little about it"""
MAX_BACKGROUND_ROWS = 32
WINDOW_FRAMES = 512
"""Earlier frames do not belong to the background: the light changes"""

Row = NDArray[np.float32]
Rows = NDArray[np.float32]


def background_frames(number: int) -> list[int]:
    """Return which earlier frames of a track are the background of a frame, oldest first.

    They are spread evenly over the last WINDOW_FRAMES, and at most MAX_BACKGROUND_ROWS. The
    successive frames of a track share most of them, so that a reader can cache their rows.

    Args:
        number: Number of frames before this one; they are counted from 0.
    """
    first = max(0, number - WINDOW_FRAMES)
    stride = 1
    while (number - first) > stride * MAX_BACKGROUND_ROWS:
        stride *= 2
    return list(range(-(-first // stride) * stride, number, stride))


def subtract_background(query: Row, background: Sequence[Row] | Rows) -> Row:
    """Return a query without its background, of unit length.

    Args:
        query: (D,) float32, of unit length.
        background: (D,) float32 each, of unit length.

    Returns:
        (D,) float32; zeros if nothing is left.
    """
    if not len(background):
        return query
    total = np.sum(background, axis=0, dtype=np.float64)
    rest = query - total / (len(background) + PRIOR_ROWS)
    length = float(np.linalg.norm(rest))
    return (rest / max(length, 1e-12)).astype(np.float32)
