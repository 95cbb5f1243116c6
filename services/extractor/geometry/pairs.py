"""Chooses the pairs of photos that are matched for a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.geodesy import distances_m
from shared.geometry.cameras import Floats

NEAREST = 12
"""Photos with the most similar descriptors, for each photo"""
NEXT_IN_TIME = 6
"""Photos taken after each photo"""
MAX_PAUSE_SECONDS = 30.0
"""Between two photos of a walk"""
NEAREST_PLACES = 8
MAX_DISTANCE_M = 30.0

Pairs = NDArray[np.int32]
"""(m, 2) numbers of two photos, the smaller one first"""


def choose_pairs(
    descriptors: NDArray[np.float32],
    seconds: Floats,
    latitudes: Floats,
    longitudes: Floats,
    sections: Sequence[str | None] = (),
) -> Pairs:
    """Return the pairs of photos that may show the same: alike, or near in time or place.

    Floors that are built alike would be taken for one another. So photos of two sections are no
    pair, unless both have coordinates, which the alignment compares with the model.

    Args:
        descriptors: (n, D) L2-normalised.
        seconds: (n,) when the photos were taken; NaN where that is unknown.
        latitudes, longitudes: (n,) degrees; NaN without coordinates.
        sections: (n,) the level above the place label of each photo, such as its floor; None where
            that is unknown.
    """
    names = {name: number for number, name in enumerate({*sections} - {None})}
    section = np.array([names.get(name, -1) for name in sections or [None] * len(seconds)], int)
    is_nowhere = ~np.isfinite(latitudes) | ~np.isfinite(longitudes)

    def are_apart(one: Any, other: Any) -> NDArray[np.bool_]:
        is_labelled = (section[one] >= 0) & (section[other] >= 0)
        differ = is_labelled & (section[one] != section[other])
        apart: NDArray[np.bool_] = differ & (is_nowhere[one] | is_nowhere[other])
        return apart

    everyone = np.arange(len(descriptors))
    found = [np.empty((0, 2), np.int64)]
    for row in range(len(descriptors)):
        similarities = descriptors @ descriptors[row]
        similarities[are_apart(row, everyone)] = similarities[row] = -np.inf
        found.append(_with(row, np.argsort(-similarities, kind="stable")[:NEAREST]))
        if np.isfinite(latitudes[row]) and np.isfinite(longitudes[row]):
            metres = distances_m(latitudes[row], longitudes[row], latitudes, longitudes)
            metres[row] = np.nan
            nearest = np.argsort(metres, kind="stable")[:NEAREST_PLACES]
            found.append(_with(row, nearest[metres[nearest] <= MAX_DISTANCE_M]))
    order = np.argsort(seconds, kind="stable")[: np.isfinite(seconds).sum()]
    for step in range(1, NEXT_IN_TIME + 1):
        one, other = order[:-step], order[step:]
        is_walk = seconds[other] - seconds[one] <= MAX_PAUSE_SECONDS
        found.append(np.column_stack([one[is_walk], other[is_walk]]))
    pairs = np.sort(np.concatenate(found), axis=1)
    is_pair = (pairs[:, 0] != pairs[:, 1]) & ~are_apart(pairs[:, 0], pairs[:, 1])
    return np.unique(pairs[is_pair], axis=0).astype(np.int32)


def _with(row: int, others: NDArray[np.intp]) -> NDArray[np.int64]:
    return np.column_stack([np.full(len(others), row), others])
