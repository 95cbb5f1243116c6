"""Evidence for a place: same-place predicates, support and agreement of a ranking, location.

Two photos show the same place if they are close to each other or have the same place label.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

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


def is_different_place(a: PhotoLocation, b: PhotoLocation) -> bool:
    """Return whether two locations are certainly different places.

    They are if they are more than 100 m apart and do not have the same label, or, without
    coordinates, if their labels differ.
    """
    distance = distance_between_m(a, b)
    labels_differ = a.place is not None and b.place is not None and a.place != b.place
    if a.place is not None and a.place == b.place:
        return False
    return labels_differ if distance is None else distance > DIFFERENT_PLACE_M


EVIDENCE_DEPTH = 50  # ranks needed; a rival place below them scores at most what the last rank does
VOTING_PHOTOS = 10  # first ranks that count towards support and agreement


@dataclass(frozen=True, slots=True)
class RankedPhoto:
    """A photo of a ranking: its cosine score and where it was taken."""

    score: float
    location: PhotoLocation
    photo: Hashable = None
    """identifies the photo in other rankings of the same map; None if it is not known"""


@dataclass(frozen=True, slots=True)
class PlaceEvidence:
    """Evidence of the first ten photos of a ranking for the place of the best one.

    `support` is the sum, over those of them that show this place, of the margin of their cosine
    over the best cosine of any other place. `agreement` is their share of the ten. On generated
    places, these two separated correct from wrong estimates best among the statistics that were
    tried (best score, margin, z-score of the margin, softmax share of the place). They carry over
    to photos of other days, which lower all scores alike.
    """

    support: float
    agreement: float


def compute_evidence(
    ranking: Sequence[RankedPhoto], radius_m: float, place: PhotoLocation | None = None
) -> PlaceEvidence | None:
    """Compute the evidence of a ranking for a place.

    A search filter removes competing places, which makes the remaining ranking look too certain.
    For a filtered search, pass the unfiltered ranking of the map, and the place that the filtered
    search found.

    Args:
        ranking: photos of the map, best first, `EVIDENCE_DEPTH` ranks if there are as many.
        radius_m: radius of a place, in metres.
        place: the place in question; by default that of the best photo.

    Returns:
        The evidence; None if the ranking is empty or the place is unknown.
    """
    if not ranking:
        return None
    target = place or ranking[0].location
    if not target.is_known:
        return None
    rival_score = next(
        (r.score for r in ranking if is_different_place(target, r.location)), ranking[-1].score
    )
    voters = ranking[:VOTING_PHOTOS]
    agreeing = [r.score for r in voters if is_same_place(target, r.location, radius_m)]
    support = sum(max(0.0, score - rival_score) for score in agreeing)
    return PlaceEvidence(support, len(agreeing) / len(voters))


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
        if r.location.latitude is not None
        and is_same_place(
            PhotoLocation(first.latitude, first.longitude, None),
            PhotoLocation(r.location.latitude, r.location.longitude, None),
            radius_m,
        )
    ]
    weights = np.array([r.score - last_score for r in nearby]) + 1e-9
    latitude, longitude = weighted_centroid(
        np.array([r.location.latitude for r in nearby], dtype=np.float64),
        np.array([r.location.longitude for r in nearby], dtype=np.float64),
        weights,
    )
    # Seven decimal places are about a centimetre; more would be rounding error.
    return PhotoLocation(round(latitude, 7), round(longitude, 7), first.place)
