"""Verification of matches: which of them agree with one camera motion in a rigid scene."""

from __future__ import annotations

import numpy as np
import poselib
from numpy.typing import NDArray

from shared.matching.features import Points

MAX_EPIPOLAR_ERROR_PIXELS = 1.5  # at the working size
MIN_MATCHES = 8  # a fundamental matrix takes seven; one more can disagree
MIN_ITERATIONS = 50
MAX_ITERATIONS = 500


def verify_matches(points: Points, other_points: Points) -> NDArray[np.bool_]:
    """Return the (m,) mask of the inliers of the fundamental matrix that most matches agree with.

    LO-RANSAC of poselib with a fixed seed. With fewer than MIN_MATCHES matches, none is an inlier.

    Args:
        points: (m, 2) positions in one photo at the working size.
        other_points: (m, 2) those in the other, match by match.
    """
    if len(points) < MIN_MATCHES:
        return np.zeros(len(points), dtype=bool)
    _, info = poselib.estimate_fundamental(
        points,
        other_points,
        {
            "max_epipolar_error": MAX_EPIPOLAR_ERROR_PIXELS,
            "min_iterations": MIN_ITERATIONS,
            "max_iterations": MAX_ITERATIONS,
            "seed": 0,
        },
        {},
    )
    return np.array(info["inliers"], dtype=bool)
