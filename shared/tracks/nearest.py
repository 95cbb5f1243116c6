"""The nearest photos of a place one by one, and the others around it together.

Where more photos are near than a step of the filter can look at, those beyond the nearest ones are
taken to lie as densely as these. They only count in sums: none of them has a row of its own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from shared.tracks.photo_graph import FloatArray, PhotoTable

MAX_NEAR = 2000
"""Number of photos within reach of a belief, or of a position, that are looked at one by one"""
MIN_REACH_M = 10.0
"""Photos that are nearer to each other are not told apart by their distance"""
RINGS = 100
"""Number of distances at which photos that are not looked at one by one are weighed"""


def find_nearest(
    find: Callable[[float, int], tuple[PhotoTable, bool]], reach_m: float, limit: int
) -> tuple[PhotoTable, float]:
    """Find at most `limit` photos within reach: if there are more, those within a smaller one.

    Args:
        find: Returns photos within a reach in metres, and whether all; where there are more than a
            limit, any of them.
        reach_m: The largest reach.
        limit: Maximum number of photos.

    Returns:
        The photos, and the reach within which they are all. Of more than `limit` photos in one
        place, some are left out.
    """
    while True:
        found, is_all = find(reach_m, limit)
        if (is_all and len(found) <= limit) or reach_m <= MIN_REACH_M:
            return found.take(np.arange(min(len(found), limit))), reach_m
        reach_m /= 2


def weigh_rings(
    weigh: Callable[[FloatArray], FloatArray], complete_m: float, reach_m: float, dimensions: int
) -> tuple[float, float]:
    """Weigh the photos between two reaches, which lie as densely as within the smaller one.

    Args:
        weigh: Returns the weights of photos at (n,) distances in metres.
        complete_m: The smaller reach.
        reach_m: The larger one; the same if there are no such photos.
        dimensions: 2 for photos of an area, 1 along a path.

    Returns:
        The sum of their weights for each photo within `complete_m`, and the sum of the weights
        times the distances.
    """
    edges = np.linspace(complete_m, max(complete_m, reach_m), RINGS + 1)
    distances = (edges[1:] + edges[:-1]) / 2
    weights = weigh(distances) * np.diff((edges / complete_m) ** dimensions)
    return float(weights.sum()), float(weights @ distances)
