"""Evidence of a frame: what one photo of a track says about where it was taken.

The probabilities are those of the frame alone, without the frames before it, under the prior that
the place is in the map with `1 - OUT_OF_MAP_SHARE` and that each photo of the map is equally
probable. The filter divides by this prior to get likelihoods.

The rank of the photo of the right place follows a power law: if u is the share of the map's photos
that score at least as high as it, then u has the distribution Beta(a, 1), P(u <= t) = t**a, which
is uniform for a = 1, when scores say nothing. A photo's u is estimated from how far its score lies
above the last one of the k hits: excesses over a high threshold follow an exponential distribution
(Pickands 1975), so u = k / n * exp(-excess / mean excess). This works for any score and extractor,
without a scale that is tuned. Where a place model gives the probability of the best place
(`shared/evaluation/places/probability.py`), that replaces the power law's.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

from shared.evaluation.places.probability import OUT_OF_MAP_SHARE

RANK_EXPONENT = 0.25
"""a: the photo of the right place comes first in 3,000 photos with 3000**-0.25 = 14 %"""
MAX_EXCESS = 8.0
"""of a score, in units of the mean excess"""
MIN_TAIL = 10
"""Number of scores that the mean excess is computed from, at least"""
MIN_PROBABILITY = 1e-4

FloatArray = NDArray[np.float64]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Hit(_Frozen):
    """A photo of the map that is similar to the frame."""

    photo: str
    """id"""
    score: float
    probability: float = Field(ge=0, le=1)
    """that the frame was taken at this photo; over all photos it adds up to 1 - not_in_map"""


class PositionFix(_Frozen):
    """A position, for example of GPS."""

    latitude: float = Field(ge=-90, le=90)
    longitude: float = Field(ge=-180, le=180)
    accuracy_m: float = Field(gt=0, le=100_000)
    """radius that contains the true position with a probability of 68 %"""


class Odometry(_Frozen):
    """Motion since the frame before."""

    distance_m: float = Field(ge=0, le=1_000_000)
    """along the path"""
    distance_accuracy_m: float = Field(gt=0, le=1_000_000)
    """standard deviation"""
    heading_change_degrees: float | None = Field(default=None, ge=-360, le=360)
    """clockwise"""
    heading_accuracy_degrees: float = Field(default=10.0, gt=0, le=180)
    """standard deviation"""


class FrameEvidence(_Frozen):
    """What one frame says about where it was taken."""

    time: AwareDatetime
    hits: tuple[Hit, ...] = ()
    not_in_map: float = Field(default=OUT_OF_MAP_SHARE, ge=0, le=1)
    """probability that the map has no photo of the place"""
    fix: PositionFix | None = None
    odometry: Odometry | None = None


def frame_evidence(
    time: datetime,
    photos: Sequence[str],
    scores: Sequence[float],
    photo_count: int,
    *,
    not_in_map: float | None = None,
    best_place: tuple[Sequence[bool], float] | None = None,
    fix: PositionFix | None = None,
    odometry: Odometry | None = None,
) -> FrameEvidence:
    """Compute the evidence of a frame from its ranking.

    Args:
        time: When the frame was taken.
        photos: (k,) ids of the first photos of the map.
        scores: (k,) their scores, highest first.
        photo_count: Number of photos of the map, at least k.
        not_in_map: From the place model, if the map has coordinates or labels.
        best_place: Which of the photos show the place of the estimate's finest level, and the
            probability of this level, from the place model.
        fix: A position measured at the same time.
        odometry: Motion since the frame before.
    """
    missing = OUT_OF_MAP_SHARE if not_in_map is None else not_in_map
    missing = min(max(missing, MIN_PROBABILITY), 1 - MIN_PROBABILITY)
    shares, rest = rank_shares(np.asarray(scores, dtype=np.float64), photo_count)
    probabilities = shares * (1 - missing)
    if best_place is not None and any(best_place[0]):
        inside = np.asarray(best_place[0], dtype=bool)
        probability = min(
            max(best_place[1], MIN_PROBABILITY), (1 - missing) * (1 - MIN_PROBABILITY)
        )
        others = float(shares[~inside].sum()) + rest
        probabilities[inside] = probability * shares[inside] / shares[inside].sum()
        probabilities[~inside] = (1 - missing - probability) * shares[~inside] / max(others, 1e-12)
    hits = tuple(
        Hit(photo=photo, score=score, probability=probability)
        for photo, score, probability in zip(photos, scores, probabilities.tolist(), strict=True)
    )
    return FrameEvidence(time=time, hits=hits, not_in_map=missing, fix=fix, odometry=odometry)


def rank_shares(scores: FloatArray, photo_count: int) -> tuple[FloatArray, float]:
    """Return how probable each hit is to show the right place, and any other photo of the map.

    Args:
        scores: (k,), highest first.
        photo_count: Number of photos of the map.

    Returns:
        (k,) shares, and the share of all other photos together. They add up to 1.
    """
    count = len(scores)
    if count == 0:
        return np.zeros(0), 1.0
    # The threshold is the last hit, or on a small map the last of the best tenth.
    tail = min(count, max(photo_count // 10, MIN_TAIL))
    excess = scores[:tail] - scores[tail - 1]
    excess = np.minimum(excess / max(float(excess.mean()), 1e-12), MAX_EXCESS)
    ranks = np.arange(1.0, count + 1)
    ranks[:tail] = tail * np.exp(-excess)
    weights = ranks ** (RANK_EXPONENT - 1)
    within = (count / max(photo_count, count)) ** RANK_EXPONENT
    return within * weights / weights.sum(), 1 - within
