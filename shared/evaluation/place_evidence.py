"""When two photos show the same place: near each other, or under one label.

What a ranking tells of the place: by how much it leads, and how many photos agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shared.geodesy import distance_m, weighted_centroid

# Farther away than this, or under another label, is certainly another place. Between the radius
# that counts as right and this lies what is neither.
DIFFERENT_PLACE_M = 100.0


@dataclass(frozen=True, slots=True)
class PhotoLocation:
    """Where a photo was taken, as far as it is known; coordinates come in pairs, in degrees."""

    latitude: float | None
    longitude: float | None
    place: str | None

    @property
    def is_known(self) -> bool:
        return self.latitude is not None or self.place is not None


def distance_between_m(one: PhotoLocation, other: PhotoLocation) -> float | None:
    """None where one of them has no coordinates."""
    if one.latitude is None or one.longitude is None:
        return None
    if other.latitude is None or other.longitude is None:
        return None
    return distance_m(one.latitude, one.longitude, other.latitude, other.longitude)


def is_same_place(one: PhotoLocation, other: PhotoLocation, radius_m: float) -> bool:
    """Within `radius_m` of each other, or under one label."""
    if one.place is not None and one.place == other.place:
        return True
    away = distance_between_m(one, other)
    return away is not None and away <= radius_m


def is_different_place(one: PhotoLocation, other: PhotoLocation) -> bool:
    """Certainly another place: another label or more than 100 m away, and nothing against it."""
    away = distance_between_m(one, other)
    labels_differ = one.place is not None and other.place is not None and one.place != other.place
    if one.place is not None and one.place == other.place:
        return False
    return labels_differ if away is None else away > DIFFERENT_PLACE_M


EVIDENCE_DEPTH = (
    50  # ranks looked at; a rival that is not among them scores at most what the last does
)
VOTING_PHOTOS = 10  # of them, those that may agree with the first


@dataclass(frozen=True, slots=True)
class RankedPhoto:
    """One photo of a ranking: the score that ranks it (a cosine) and where it was taken."""

    score: float
    spot: PhotoLocation


@dataclass(frozen=True, slots=True)
class PlaceEvidence:
    """How the first ten photos speak for the place of the best one.

    `support`: the sum, over those of them that show that place, of how much higher their cosine is
    than the best one of any other place. `agreement`: their share. Of the statistics that were
    tried on generated places (best score, lead, z-score of the lead, softmax share of the place)
    these two told right from wrong best, and carry over to photos of other days, which lower all
    scores alike.
    """

    support: float
    agreement: float


def compute_evidence(
    ranking: Sequence[RankedPhoto], radius_m: float, place: PhotoLocation | None = None
) -> PlaceEvidence | None:
    """How a ranking, best first, speaks for `place`; left out: for the place of its best photo.

    A filter takes rivals away, and what is left would look sure of itself: weigh the ranking of the
    whole map for the place that the filter let through. None when the ranking is empty or the
    place is not known.
    """
    if not ranking:
        return None
    first = place or ranking[0].spot
    if not first.is_known:
        return None
    rival = next((r.score for r in ranking if is_different_place(first, r.spot)), ranking[-1].score)
    voters = ranking[:VOTING_PHOTOS]
    agreeing = [r.score for r in voters if is_same_place(first, r.spot, radius_m)]
    support = sum(max(0.0, score - rival) for score in agreeing)
    return PlaceEvidence(support, len(agreeing) / len(voters))


def estimate_location(ranking: Sequence[RankedPhoto], radius_m: float) -> PhotoLocation:
    """Where the ranking points to: the first photo's label, and the centre of the first ten that
    lie within `radius_m` of it, each weighed by its score's lead over the last of the ranking."""
    first = ranking[0].spot
    if first.latitude is None:
        return first
    floor = ranking[-1].score
    near = [
        r
        for r in ranking[:VOTING_PHOTOS]
        if r.spot.latitude is not None
        and is_same_place(
            PhotoLocation(first.latitude, first.longitude, None),
            PhotoLocation(r.spot.latitude, r.spot.longitude, None),
            radius_m,
        )
    ]
    weights = np.array([r.score - floor for r in near]) + 1e-9
    latitude, longitude = weighted_centroid(
        np.array([r.spot.latitude for r in near], dtype=np.float64),
        np.array([r.spot.longitude for r in near], dtype=np.float64),
        weights,
    )
    # Seven digits are a centimetre; more would be rounding errors.
    return PhotoLocation(round(latitude, 7), round(longitude, 7), first.place)
