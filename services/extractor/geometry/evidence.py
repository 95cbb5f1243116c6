"""Coordinates as evidence for a model: which matches of photos contradict them.

Facades and floors that repeat match as if they were one. Where photos are by their coordinates
tells such matches before a model is made of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import poselib
from numpy.typing import NDArray

from services.extractor.geometry.matching import VerifiedMatches
from shared.geometry.cameras import UNKNOWN_FOCAL_LENGTH, Floats
from shared.geometry.frames import GPS_SIGMA_M, UNKNOWN_ALTITUDE_SIGMA_M, Similarity, fit_similarity
from shared.matching.features import WORKING_SIDE
from shared.matching.verification import MAX_EPIPOLAR_ERROR_PIXELS

if TYPE_CHECKING:
    from services.extractor.geometry.mapping import PhotoToMap

NEAR_M = 3 * GPS_SIGMA_M
"""Coordinates that are so near each other contradict no match"""
MAX_STEPS = 3.0
"""Distance of two photos that match, in usual steps or in what their parallax makes of these"""
SURE_MATCHES = 2
"""Best pairs of each photo, which are hardly ever wrong"""
SMOOTHED_WITH = 6
"""Best pairs of each photo whose coordinates make its own more exact"""
PASSES = 5
"""Each time, the coordinates are made more exact by pairs that have not contradicted them yet"""
MAX_MEASURED = 150
"""Pairs of which the usual parallax is measured"""
MIN_BLOCK = 3
"""Photos that are off together; fewer may have wrong coordinates"""
MIN_NEARER_SHARE = 0.3
"""of a photo's matches with photos that are nearer by their coordinates than in the model"""
OFF_SIGMAS, MIN_OFF_M = 4.0, 2.0
"""How far a block is from its coordinates, in standard deviations of all photos' and in metres"""
RAYLEIGH_MEDIAN = 1.1774
"""Median distance in two dimensions, in standard deviations"""


def without_contradictions(
    photos: Sequence[PhotoToMap], matches: VerifiedMatches
) -> VerifiedMatches:
    """Return the matches without those of photos that are too far apart by their coordinates.

    How far that is, is learned from the best pairs of each photo: the median of their distances
    contains the photos' steps as well as the errors of their coordinates. Two photos with more
    parallax than these may be farther apart in proportion. Coordinates that contradict most matches
    of a photo are not believed, and drop none.
    """
    places = {photo.id: photo.position for photo in photos}
    own = np.array([_horizontal(places.get(id_)) for id_ in matches.photo_ids])
    one, other = matches.pairs.reshape(-1, 2).T
    counts = np.array([len(k) for k in matches.keypoints], int)
    contradicts = np.zeros(len(counts), dtype=bool)
    pixels = {photo.id: _rays(photo) for photo in photos}

    @cache
    def parallax(pair: int) -> float:
        of_one, of_other = (pixels[matches.photo_ids[n]] for n in matches.pairs[pair])
        keypoints = matches.keypoints[pair]
        return _parallax(of_one[keypoints[:, 0]], of_other[keypoints[:, 1]])

    positions = own
    for _ in range(PASSES):
        distances = np.linalg.norm(positions[one] - positions[other], axis=1)
        agreeing = np.where(np.isfinite(distances) & ~contradicts, counts, 0)
        sure = _best_pairs(one, other, agreeing)
        step = float(np.median(distances[sure])) if len(sure) else np.inf
        contradicts = distances > max(NEAR_M, MAX_STEPS * step)
        if contradicts.any():
            chosen = np.random.default_rng(0).permutation(sure)[:MAX_MEASURED]
            usual = max(1e-9, float(np.median([parallax(n) for n in chosen.tolist()])))
        for pair in np.flatnonzero(contradicts).tolist():
            reach = MAX_STEPS * step * parallax(pair) / usual
            contradicts[pair] = distances[pair] > reach
        positions = _smoothed(own, one, other, counts, contradicts)
    return matches.only(~contradicts)


def _horizontal(position: Floats | None) -> Floats:
    return np.full(2, np.nan) if position is None else position[:2]


def _best_pairs(one: Any, other: Any, counts: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the pairs that are among the SURE_MATCHES best of one of their photos."""
    taken = Counter[int]()
    best = []
    for pair in np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)].tolist():
        ends = int(one[pair]), int(other[pair])
        if min(taken[end] for end in ends) < SURE_MATCHES:
            best.append(pair)
        taken.update(ends)
    return np.array(best, np.intp)


def _smoothed(
    positions: Floats, one: Any, other: Any, counts: Any, contradicts: NDArray[np.bool_]
) -> Floats:
    """Return (n, 2) medians of the positions of each photo and of those that match it best.

    Contradicting pairs are left out, unless they are most of a photo's: then it is the photo's own
    position that is wrong.
    """
    found = positions.copy()
    for photo in range(len(positions)):
        pairs = np.flatnonzero((one == photo) | (other == photo))
        pairs = pairs[np.argsort(-counts[pairs], kind="stable")]
        agreeing = pairs[~contradicts[pairs]]
        if 2 * counts[agreeing].sum() >= counts[pairs].sum():
            pairs = agreeing
        best = pairs[:SMOOTHED_WITH]
        near = positions[[photo, *(one[best] + other[best] - photo).tolist()]]
        if np.isfinite(near).any():
            found[photo] = np.nanmedian(near, axis=0)
    return found


def _rays(photo: PhotoToMap) -> Floats:
    """Return the (n, 2) keypoints in units of the focal length, relative to the photo's middle."""
    focal = photo.focal_length or UNKNOWN_FOCAL_LENGTH
    middle = np.array([photo.width, photo.height]) / 2
    rays: Floats = (photo.pixels - middle) / (focal * max(photo.width, photo.height))
    return rays


def _parallax(rays: Floats, other_rays: Floats) -> float:
    """Return the distance of two cameras in median distances to what both see."""
    camera = {"model": "SIMPLE_PINHOLE", "width": 2, "height": 2, "params": [1.0, 0.0, 0.0]}
    error = MAX_EPIPOLAR_ERROR_PIXELS / WORKING_SIDE
    options = {"max_epipolar_error": error, "max_iterations": 500, "seed": 0}
    pose, info = poselib.estimate_relative_pose(rays, other_rays, camera, camera, options, {})
    is_inlier = np.array(info["inliers"], dtype=bool)
    if not is_inlier.any():
        return 0.0
    first, second = (
        np.column_stack([r[is_inlier], np.ones(int(is_inlier.sum()))]) for r in (rays, other_rays)
    )
    first = first @ pose.R.T
    # A point is at the depth z of the second camera where first x (z * second - t) = 0.
    translation = pose.t / max(1e-12, float(np.linalg.norm(pose.t)))
    across = np.linalg.norm(np.cross(first, second), axis=1)
    depths = np.linalg.norm(np.cross(first, translation), axis=1) / np.maximum(across, 1e-9)
    return float(1 / max(1e-9, float(np.median(depths))))


def find_misplaced(
    centres: Floats,
    rotations: Sequence[Floats],
    positions: Floats,
    pairs: NDArray[np.int32],
    counts: NDArray[np.intp],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the (n,) photos that a model has at a wrong place, and the (m,) pairs that led there.

    Photos that match each other and are off their coordinates together were joined to the rest by
    matches of something else that looks alike. So was a single photo, if others that it matches are
    near it by their coordinates, but not in the model; if not, its coordinates are wrong.

    Args:
        centres: (n, 3) of the model's photos.
        rotations: (3, 3) of each, from the model to its camera's axes.
        positions: (n, 3) metres by their coordinates; NaN where unknown.
        pairs: (m, 2) numbers of photos that match.
        counts: (m,) matches of each pair.
    """
    nothing = np.zeros(len(centres), dtype=bool), np.zeros(len(pairs), dtype=bool)
    known = np.flatnonzero(np.isfinite(positions[:, :2]).all(axis=1))
    if len(known) < MIN_BLOCK:
        return nothing
    fitted = fit_to_positions(
        centres[known], [rotations[i] for i in known.tolist()], positions[known]
    )
    if fitted is None:
        return nothing
    modelled = fitted.apply(centres)[:, :2]
    own = positions[:, :2] - modelled
    one, other = pairs.reshape(-1, 2).T
    shared = _smoothed(own, one, other, counts, nothing[1])
    off, off_together = (_is_off(offsets) for offsets in (own, shared))
    near, modelled_near = (
        np.linalg.norm(places[one] - places[other], axis=1) for places in (positions, modelled)
    )
    off_together &= _has_size(off_together, one, other)
    limit = math.sqrt(2) * _limit(own)  # of the distance of two photos
    for photo in np.flatnonzero(off & ~off_together).tolist():
        of_photo = (one == photo) | (other == photo)
        nearer = of_photo & (2 * near < modelled_near) & (modelled_near > _limit(own))
        off_together[photo] = counts[nearer].sum() >= MIN_NEARER_SHARE * counts[of_photo].sum()
    contradicts = (off_together[one] | off_together[other]) & (near > modelled_near + limit)
    return off_together, contradicts


def _limit(offsets: Floats) -> float:
    """Return how far photos with right coordinates may be from their places in the model."""
    distances = np.linalg.norm(offsets, axis=1)
    return max(MIN_OFF_M, OFF_SIGMAS * float(np.nanmedian(distances)) / RAYLEIGH_MEDIAN)


def _is_off(offsets: Floats) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = np.linalg.norm(offsets, axis=1) > _limit(offsets)
    return found


def _has_size(is_off: NDArray[np.bool_], one: Any, other: Any) -> NDArray[np.bool_]:
    """Return the photos that are in a group of MIN_BLOCK matched ones or more that are off."""
    joined = is_off[one] & is_off[other]
    one, other = one[joined], other[joined]
    labels, before = np.arange(len(is_off)), None
    while before is None or (labels != before).any():  # each photo takes the least of its group
        before = labels.copy()
        np.minimum.at(labels, one, before[other])
        np.minimum.at(labels, other, labels[one])
    found: NDArray[np.bool_] = np.bincount(labels)[labels] >= MIN_BLOCK
    return found


def fit_to_positions(
    centres: Floats, rotations: Sequence[Floats], positions: Floats
) -> Similarity | None:
    """Return the similarity that leads from a model to positions (n, 3); None if there is none.

    A height that is unknown (NaN) is about that of the others.
    """
    sigmas = np.full((len(centres), 3), GPS_SIGMA_M)
    sigmas[np.isnan(positions[:, 2]), 2] = UNKNOWN_ALTITUDE_SIGMA_M
    has_altitudes = bool(np.isfinite(positions[:, 2]).any())
    targets = with_heights(positions)
    fitted = fit_similarity(centres, targets, rotations, sigmas, has_altitudes)
    return None if isinstance(fitted, str) else fitted[0]


def with_heights(positions: Floats) -> Floats:
    """Return positions (n, 3) with the median of the heights where they have none (NaN)."""
    heights = positions[:, 2]
    middle = float(np.nanmedian(heights)) if np.isfinite(heights).any() else 0.0
    return np.column_stack([positions[:, :2], np.where(np.isfinite(heights), heights, middle)])
