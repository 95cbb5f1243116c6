"""Evidence of a frame: what one photo of a track says about where it was taken.

The probabilities are those of the frame alone, without the frames before it, given that its place
is in the map and under the prior that each photo of the map is equally probable. The filter divides
by this prior to get likelihoods.

The rank of the photo of the right place follows a power law: if u is the share of the map's photos
that score at least as high as it, then u has the distribution Beta(a, 1), P(u <= t) = t**a, which
is uniform for a = 1, when scores say nothing. A photo's u is estimated from how far its score lies
above the last one of the k hits: excesses over a high threshold follow an exponential distribution
(Pickands 1975), so u = k / n * exp(-excess / mean excess). This works for any score and extractor,
without a scale that is tuned.

The scores are those of a search with the earlier frames as its background
(`shared/search_api/background.py`): what all frames of a ride have in common, such as snow or the
light of street lamps, says nothing about the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

RANK_EXPONENT = 0.25
"""a: the photo of the right place comes first in 3,000 photos with 3000**-0.25 = 14 %"""
MAX_EXCESS = 8.0
"""of a score, in units of the mean excess"""
MIN_TAIL = 10
"""Number of scores that the mean excess is computed from, at least"""
HITS = 200
"""Number of first photos of the map that a frame's evidence is computed from"""

MAX_ACCURACY_M = 100_000

FloatArray = NDArray[np.float64]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Hit(_Frozen):
    """A photo of the map that is similar to the frame."""

    photo: str
    """id"""
    score: float
    probability: float = Field(ge=0, le=1)
    """that the frame was taken at this photo; over all photos of the map it adds up to 1"""


class PositionFix(_Frozen):
    """A position, for example of GPS, or of the frame's pose."""

    latitude: float = Field(ge=-90, le=90)
    longitude: float = Field(ge=-180, le=180)
    accuracy_m: float = Field(gt=0, le=MAX_ACCURACY_M)
    """radius that contains the true position with a probability of 68 %"""
    radius_95_m: float | None = Field(None, gt=0)
    """of a pose; None of other positions"""
    heading: float | None = Field(None, ge=0, le=360)
    """of a pose: degrees clockwise from north"""


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
    missing: float | None = None
    """`PlaceModel.missing_log_odds`"""
    fix: PositionFix | None = None
    odometry: Odometry | None = None


def frame_evidence(
    time: datetime,
    photos: Sequence[str],
    scores: Sequence[float],
    photo_count: int,
    *,
    missing: float | None = None,
    fix: PositionFix | None = None,
    odometry: Odometry | None = None,
) -> FrameEvidence:
    """Compute the evidence of a frame from its ranking.

    Args:
        time: When the frame was taken.
        photos: (k,) ids of the first photos of the map.
        scores: (k,) their scores, highest first.
        photo_count: Number of photos of the map, at least k.
        missing: `PlaceModel.missing_log_odds`, of a search without background.
        fix: A position measured at the same time.
        odometry: Motion since the frame before.
    """
    shares, _ = rank_shares(np.asarray(scores, dtype=np.float64), photo_count)
    hits = tuple(
        Hit(photo=photo, score=score, probability=probability)
        for photo, score, probability in zip(photos, scores, shares.tolist(), strict=True)
    )
    return FrameEvidence(time=time, hits=hits, missing=missing, fix=fix, odometry=odometry)


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
    # On a small map, the best score would be most of the mean that it is measured by.
    scale = float(excess[1:].mean() if tail > 2 else excess.mean())
    excess = np.minimum(excess / max(scale, 1e-12), MAX_EXCESS)
    ranks = np.arange(1.0, count + 1)
    ranks[:tail] = tail * np.exp(-excess)
    weights = ranks ** (RANK_EXPONENT - 1)
    within = (count / max(photo_count, count)) ** RANK_EXPONENT
    return within * weights / weights.sum(), 1 - within
