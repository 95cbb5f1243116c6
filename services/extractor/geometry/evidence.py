"""Coordinates as evidence for a model: which matches of photos contradict them.

Facades and floors that repeat match as if they were one. Where photos are by their coordinates
tells such matches before a model is made of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.matching import VerifiedMatches
from services.extractor.geometry.pycolmap_models import PhotoToMap
from shared.errors import Unprocessable
from shared.geometry.cameras import Floats
from shared.geometry.frames import GPS_SIGMA_M, UNKNOWN_ALTITUDE_SIGMA_M, Similarity, fit_similarity

NEAR_M = 3 * GPS_SIGMA_M
"""Coordinates that are so near each other contradict no match"""
MAX_STEPS = 3.0
"""Distance of two photos that match, in usual steps"""
MIN_FIRST_STEPS = 1.4
"""Usual steps by the coordinates as they are, of which SMOOTHED_WITH of them leave three sigmas"""
SURE_MATCHES = 2
"""Best pairs of each photo, which are hardly ever wrong"""
SMOOTHED_WITH = 6
"""Best pairs of each photo whose coordinates make its own more exact"""
PASSES = 5
"""Each time, the coordinates are made more exact by pairs that have not contradicted them yet"""
MIN_BLOCK = 3
"""Photos that are off together; fewer may have wrong coordinates"""
MIN_NEARER_SHARE = 0.3
"""of a photo's matches with photos that are nearer by their coordinates than in the model"""
OFF_SIGMAS, MIN_OFF_M = 4.0, 2.0
"""How far a block is from its coordinates, in standard deviations of all photos' and in metres"""
MAX_INDEPENDENT = 9
"""Positions of a block whose errors are independent, at most"""
RAYLEIGH_MEDIAN = 1.1774
"""Median distance in two dimensions, in standard deviations"""
NO_MATCHES = "No other photo shows the same"
CONTRADICTED = (
    "By their coordinates, some photos that look the same were taken elsewhere, and the others "
    "share too few points with them"
)
UNCONNECTED = (
    "They share too few points with the photos of a component, or are at another place in it than "
    "by their coordinates"
)


def explain_left_out(photos: Sequence[PhotoToMap], matches: VerifiedMatches) -> dict[UUID, str]:
    """Return why each photo would be in no component, as a sentence without its full stop."""
    reasons = [NO_MATCHES] * len(matches.photo_ids)
    for chosen, reason in ((..., UNCONNECTED), (~agreeing_pairs(photos, matches), CONTRADICTED)):
        for number in matches.pairs[chosen].ravel().tolist():
            reasons[number] = reason
    return dict(zip(matches.photo_ids, reasons, strict=True))


def agreeing_pairs(photos: Sequence[PhotoToMap], matches: VerifiedMatches) -> NDArray[np.bool_]:
    """Return the (m,) pairs without those of photos that are too far apart by their coordinates.

    How far that is, is learned from the best pairs of each photo: the median of their distances
    contains the photos' steps as well as the errors of their coordinates. Coordinates that
    contradict most matches of a photo are not believed, and drop none.
    """
    own = positions_of(matches.photo_ids, photos)[:, :2]
    one, other = matches.pairs.reshape(-1, 2).T
    counts = np.array([len(k) for k in matches.keypoints], int)
    contradicts = np.zeros(len(counts), dtype=bool)
    positions, first_step = own, 0.0
    for _ in range(PASSES):
        distances = np.linalg.norm(positions[one] - positions[other], axis=1)
        agreeing = np.where(np.isfinite(distances) & ~contradicts, counts, 0)
        sure = best_pairs(one, other, agreeing)
        step = float(np.median(distances[sure])) if len(sure) else np.inf
        first_step = first_step or step
        contradicts = distances > max(NEAR_M, MAX_STEPS * step, MIN_FIRST_STEPS * first_step)
        positions = _smoothed(own, one, other, counts, contradicts)
    return ~contradicts


def positions_of(ids: Iterable[UUID], photos: Sequence[PhotoToMap]) -> Floats:
    """Return the positions (n, 3) of photos, NaN where they are unknown."""
    known = {photo.id: photo.position for photo in photos if photo.position is not None}
    places = [known.get(id_, (np.nan,) * 3) for id_ in ids]
    return np.array(places, float).reshape(-1, 3)


def best_pairs(one: Any, other: Any, counts: NDArray[np.intp]) -> NDArray[np.intp]:
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


def find_misplaced(
    centres: Floats,
    rotations: Sequence[Floats],
    positions: Floats,
    pairs: NDArray[np.int32],
    counts: NDArray[np.intp],
    blocks: NDArray[np.intp],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the (n,) photos that a model has at a wrong place, and the (m,) pairs that led there.

    Photos that match each other and are off their coordinates together were joined to the rest by
    matches of something else that looks alike. So were one or two photos, if others that they match
    are near by their coordinates, but not in the model; if not, their coordinates are wrong. So is
    a block that only looks like the rest, unless its coordinates confirm its place.

    Args:
        centres: (n, 3) of the model's photos.
        rotations: (3, 3) of each, from the model to its camera's axes.
        positions: (n, 3) metres by their coordinates; NaN where unknown.
        pairs: (m, 2) numbers of photos that match.
        counts: (m,) matches of each pair.
        blocks: (n,) of `find_lookalikes`.
    """
    is_alike = blocks > 0
    nothing = is_alike, np.zeros(len(pairs), dtype=bool)
    known = np.flatnonzero(np.isfinite(positions[:, :2]).all(axis=1) & ~is_alike)
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
    limit = _limit(own)
    off = np.linalg.norm(own, axis=1) > limit
    # Medians of SMOOTHED_WITH positions and the photo's own are twice as exact as these.
    off_together = np.linalg.norm(shared, axis=1) > max(_limit(shared), limit / 2)
    near, modelled_near = (
        np.linalg.norm(places[one] - places[other], axis=1) for places in (positions, modelled)
    )
    groups = _groups(off_together, one, other)
    off_together &= np.bincount(groups)[groups] >= MIN_BLOCK
    off &= ~off_together
    groups = _groups(off, one, other)
    for group in np.unique(groups[off]):
        members = off & (groups == group)
        crossing = members[one] != members[other]
        nearer = crossing & (2 * near < modelled_near) & (modelled_near > limit)
        off_together |= members & (
            counts[nearer].sum() >= max(1, MIN_NEARER_SHARE * counts[crossing].sum())
        )
    contradicts = (off_together[one] | off_together[other]) & (
        near > modelled_near + math.sqrt(2) * limit
    )
    for block in np.unique(blocks[is_alike]):
        offsets = own[(blocks == block) & np.isfinite(own[:, 0])]
        # Its mean is more exact than each position, but receivers are off by the same for minutes.
        exactness = limit / math.sqrt(max(1, min(MAX_INDEPENDENT, len(offsets))))
        apart = np.linalg.norm(np.mean(offsets, axis=0)) if len(offsets) else np.inf
        is_alike[blocks == block] = not apart <= max(MIN_OFF_M, exactness)
    return off_together | is_alike, contradicts


def _limit(offsets: Floats) -> float:
    """Return how far photos with right coordinates may be from their places in the model."""
    distances = np.linalg.norm(offsets, axis=1)
    return max(MIN_OFF_M, OFF_SIGMAS * float(np.nanmedian(distances)) / RAYLEIGH_MEDIAN)


def _groups(is_member: NDArray[np.bool_], one: Any, other: Any) -> NDArray[np.intp]:
    """Return the least number of the members that each photo is joined with by matches of these."""
    joined = is_member[one] & is_member[other]
    one, other = one[joined], other[joined]
    labels, before = np.arange(len(is_member)), None
    while before is None or (labels != before).any():  # each photo takes the least of its group
        before = labels.copy()
        np.minimum.at(labels, one, before[other])
        np.minimum.at(labels, other, labels[one])
    return labels


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
    try:
        return fit_similarity(centres, targets, rotations, sigmas, has_altitudes)[0]
    except Unprocessable:
        return None


def with_heights(positions: Floats) -> Floats:
    """Return positions (n, 3) with the median of the heights where they have none (NaN)."""
    heights = positions[:, 2]
    middle = float(np.nanmedian(heights)) if np.isfinite(heights).any() else 0.0
    return np.column_stack([positions[:, :2], np.where(np.isfinite(heights), heights, middle)])
