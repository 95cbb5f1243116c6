"""Photos of a ranking with their locations: same-place predicates, and the position they point to.

Two photos show the same place if they are close to each other or have the same place label.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shared.geodesy import distance_m, weighted_centroid

# Farther away than this, or with another label, is a different place. Photos between the positive
# radius and this distance are neither the same place nor a different one.
DIFFERENT_PLACE_M = 100.0


@dataclass(frozen=True, slots=True)
class PhotoLocation:
    """Where a photo was taken: coordinates in degrees (both or neither) and a place label."""

    latitude: float | None
    longitude: float | None
    place: str | None

    @property
    def is_known(self) -> bool:
        return self.latitude is not None or self.place is not None


def distance_between_m(a: PhotoLocation, b: PhotoLocation) -> float | None:
    """Return the distance in metres; None if a location has no coordinates."""
    if a.latitude is None or a.longitude is None:
        return None
    if b.latitude is None or b.longitude is None:
        return None
    return distance_m(a.latitude, a.longitude, b.latitude, b.longitude)


def is_same_place(a: PhotoLocation, b: PhotoLocation, radius_m: float) -> bool:
    """Return whether two locations are within `radius_m` or have the same label."""
    if a.place is not None and a.place == b.place:
        return True
    distance = distance_between_m(a, b)
    return distance is not None and distance <= radius_m


EVIDENCE_DEPTH = 50  # ranks needed; a rival place below them scores at most what the last rank does
VOTING_PHOTOS = 10  # first ranks that determine the position


@dataclass(frozen=True, slots=True)
class RankedPhoto:
    """A photo of a ranking: its cosine score and where it was taken."""

    score: float
    location: PhotoLocation
    photo: Hashable = None
    """identifies the photo in other rankings of the same map; None if it is not known"""
    support: float | None = None
    """`match_support` of its local features and the query's; None if they were not compared"""


MATCHED_PHOTOS = 10  # first ranks whose matches are evidence


def match_support(matches: int, inliers: int) -> float:
    """Return how much the matches of two photos say that they show the same place.

    The number of inliers times their share of the matches: places that look alike have many
    matches, of which fewer agree with one camera motion.
    """
    return inliers * inliers / max(1, matches)


def without_matches(ranking: Sequence[RankedPhoto]) -> list[RankedPhoto]:
    """Return the ranking as if no photo had been compared with the query."""
    return [replace(r, support=None) for r in ranking]


def are_matched(ranking: Sequence[RankedPhoto]) -> bool:
    """Return whether the first MATCHED_PHOTOS of a ranking were compared with the query."""
    first = ranking[:MATCHED_PHOTOS]
    return bool(first) and all(r.support is not None for r in first)


def estimate_location(ranking: Sequence[RankedPhoto], radius_m: float) -> PhotoLocation:
    """Estimate the location of a query from its ranking, which must not be empty.

    The label is the best photo's. The coordinates are the weighted centroid of those of the first
    ten photos that are within `radius_m` of the best one. The weight of a photo is the margin of
    its score over the last score of the ranking.
    """
    first = ranking[0].location
    if first.latitude is None:
        return first
    last_score = ranking[-1].score
    nearby = [
        r
        for r in ranking[:VOTING_PHOTOS]
        if (away_m := distance_between_m(first, r.location)) is not None and away_m <= radius_m
    ]
    weights = np.array([r.score - last_score for r in nearby]) + 1e-9
    latitude, longitude = weighted_centroid(
        np.array([r.location.latitude for r in nearby], dtype=np.float64),
        np.array([r.location.longitude for r in nearby], dtype=np.float64),
        weights,
    )
    # Seven decimal places are about a centimetre; more would be rounding error.
    return PhotoLocation(round(latitude, 7), round(longitude, 7), first.place)
