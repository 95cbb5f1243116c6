"""Blocks of a model that only look like the rest: repeated facades joined them to it.

Photos that a model has at the same place should see the same points. Those of two places that look
alike share the repeated part alone, and miss what each has of its own (Heinly et al., ECCV 2014).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.pairs import Pairs
from shared.geometry.cameras import Floats
from shared.geometry.component import Component

MIN_EXPECTED = 30
"""Points that two photos should share, to tell what they usually do"""
SAME_VIEW_COSINE, SAME_VIEW_SCALE = math.cos(math.radians(20)), 1.5
"""A detector finds a point again from directions and distances that differ by less"""
ALIKE_SHARE = 0.5
"""of what photos usually share of the points that they should: less contradicts their poses"""
MIN_MISSING = 60.0
"""Points that the photos of two blocks lack together, to contradict"""


def find_lookalikes(component: Component, pairs: Pairs) -> tuple[NDArray[np.intp], Floats]:
    """Return the (n,) block of each photo, and the (m,) points that each pair has more than enough.

    Block 0 is the rest of the model. The photos of another block contradict those of a larger one.

    Args:
        pairs: (m, 2) rows of photos that match.
    """
    expected, common = _count_shared(component, pairs)
    share = common / np.maximum(expected, 1)
    best = np.zeros(len(component.photo_ids))
    for side in pairs[expected >= MIN_EXPECTED].T:
        np.maximum.at(best, side, share[expected >= MIN_EXPECTED])
    usual = float(np.median(best[best > 0])) if best.any() else 0.0
    excess = common - ALIKE_SHARE * usual * expected
    labels = _cluster(len(best), pairs, excess)
    between = _sums(len(best), labels[pairs], excess)
    found, kept = np.zeros(len(best), np.intp), list[int]()
    for label in sorted(set(labels.tolist()), key=labels.tolist().count, reverse=True):
        if between[label, kept].min(initial=0) < -MIN_MISSING:
            found[labels == label] = label + 1
        else:
            kept.append(label)
    return found, excess


def _count_shared(component: Component, pairs: Pairs) -> NDArray[np.intp]:
    """Return (2, m): points that two photos should both see, and that they do.

    Of the two, that counts which should see fewer of the other's.
    """
    centres = component.centres()
    seen = [np.unique(numbers[numbers >= 0]) for numbers in component.point_numbers]

    def count(one: int, other: int) -> tuple[int, int]:
        rays, others = (component.points[seen[one]] - centres[row] for row in (one, other))
        lengths, other_lengths = (np.linalg.norm(each, axis=1) for each in (rays, others))
        camera = component.cameras[component.camera_numbers[other]]
        axes = others @ component.rotation(other).T
        is_same = np.sum(rays * others, axis=1) > SAME_VIEW_COSINE * lengths * other_lengths
        is_same &= np.abs(np.log(lengths / other_lengths)) < math.log(SAME_VIEW_SCALE)
        is_same &= axes[:, 2] > 0
        pixels = camera.project(axes[is_same])
        inside = ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=1)
        should = seen[one][is_same][inside]
        return len(should), int(np.isin(should, seen[other]).sum())

    counts = [min(count(one, other), count(other, one)) for one, other in pairs.tolist()]
    return np.array(counts, np.intp).reshape(-1, 2).T


def _cluster(count: int, pairs: Pairs, excess: Floats) -> NDArray[np.intp]:
    """Return (count,) labels: the two groups that share most are joined, until all lack points."""
    labels, sums = np.arange(count), _sums(count, pairs, excess)
    np.fill_diagonal(sums, -np.inf)
    while sums.max(initial=0) > 0:
        one, other = np.unravel_index(sums.argmax(), sums.shape)
        sums[one] += sums[other]
        sums[:, one] = sums[one]
        sums[other] = sums[:, other] = sums[one, one] = -np.inf
        labels[labels == other] = one
    return labels


def _sums(count: int, pairs: NDArray[np.integer[Any]], values: Floats) -> Floats:
    """Return the symmetric (count, count) sums of the values of pairs."""
    sums = np.zeros((count, count))
    np.add.at(sums, tuple(pairs.T), values)
    return sums + sums.T
