"""Proposes where a photo was taken: the product of what its sources say, and why.

The sources are taken as independent given the position. Neighbours in time that have no coordinates
themselves do not count: photos of one burst look alike, so that their pictures are one evidence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

from shared.geodesy import distance_m
from shared.geotagging.evidence import (
    InterpolatedPosition,
    PictureEvidence,
    picture_mixture,
    position_mixture,
)
from shared.geotagging.mixture import REGION_RADIUS_M, Mixture, Plane

POSE_RADII = 3.0
"""A proposal that rests on a pose has the middle of so many of its radii of 68 % as position"""
CONTRADICTION = 0.5
"""Probability of a source for elsewhere from which it is named as contradicting"""


@dataclass(frozen=True, slots=True)
class Proposal:
    """Where a photo was probably taken."""

    latitude: float
    longitude: float
    radius_m: float
    probability: float
    """that the photo was taken within `radius_m` of the position"""
    radius_68_m: float
    reason: str
    heading: float | None = None
    """degrees clockwise from north; None without a pose"""


def propose_position(
    picture: PictureEvidence | None,
    neighbours: InterpolatedPosition | None,
    track: InterpolatedPosition | None,
    radius_m: float,
) -> Proposal | None:
    """Return the most probable circle of `radius_m`, given all that is known about a photo.

    None if no source has a position, the photo was certainly taken elsewhere, or its picture is all
    that is known and probably not of this map.
    """
    if picture is not None and picture.not_in_map > CONTRADICTION and not (neighbours or track):
        return None
    plane = _plane(picture, neighbours, track)
    if plane is None:
        return None
    sources: list[tuple[Mixture, str, str]] = []
    if picture is not None:
        mixture = picture_mixture(picture, plane)
        sources.append((mixture, "", "looks like another place"))
    if neighbours is not None:
        text = f"taken {_after(neighbours.seconds)} {neighbours.nearest.name}"
        if not neighbours.same_camera:
            text += ", perhaps by another camera of the same model"
        sources.append((position_mixture(neighbours, plane), text, f"not where it was {text}"))
    if track is not None:
        text = f"GPX track, {_duration(track.seconds)} from its nearest point"
        sources.append((position_mixture(track, plane), text, "not on the GPX track"))
    product = reduce(Mixture.times, (mixture for mixture, _, _ in sources))
    if not len(product.weights):
        return None
    centre, probability = product.best_circle(radius_m)
    pose = picture.pose if picture else None
    if pose and math.dist(plane.to_metres(pose.latitude, pose.longitude), centre) > radius_m:
        pose = None  # contradicted by the other sources
    if pose:
        centre, _ = product.best_circle(min(radius_m, POSE_RADII * pose.radius_68_m))
        probability = product.probability_within(centre, radius_m)
    latitude, longitude = plane.to_degrees(*centre)
    reasons = []
    for mixture, supports, contradicts in sources:
        within = mixture.probability_within(centre, radius_m)
        if within > (radius_m / REGION_RADIUS_M) ** 2:
            found = f"pose to {pose.radius_68_m:.1f} m" if pose else None
            similar = found or _looks_like(picture, latitude, longitude, radius_m)
            reasons.append(supports or similar)
        elif 1 - mixture.uniform - within > CONTRADICTION:
            reasons.append(contradicts)
    return Proposal(
        round(latitude, 7),
        round(longitude, 7),
        radius_m,
        probability,
        product.radius_m(centre, 0.68),
        "; ".join(reasons),
        round(pose.heading, 2) if pose else None,
    )


def _plane(
    picture: PictureEvidence | None,
    neighbours: InterpolatedPosition | None,
    track: InterpolatedPosition | None,
) -> Plane | None:
    """Return a plane around a position that some source has; None if there is none."""
    for known in (track, neighbours):
        if known is not None:
            return Plane(known.latitude, known.longitude)
    if picture is not None and picture.circles:
        return Plane(picture.circles[0].latitude, picture.circles[0].longitude)
    if picture is not None and picture.similar:
        return Plane(picture.similar[0].latitude, picture.similar[0].longitude)
    return None


def _looks_like(
    picture: PictureEvidence | None, latitude: float, longitude: float, radius_m: float
) -> str:
    photos: Sequence[str] = [
        photo.name
        for photo in (picture.similar if picture else ())
        if distance_m(latitude, longitude, photo.latitude, photo.longitude) <= radius_m
    ]
    return f"looks like {photos[0]}" if photos else "the picture"


def _after(seconds: float) -> str:
    if abs(seconds) < 0.5:
        return "at the same time as"
    return f"{_duration(seconds)} {'before' if seconds < 0 else 'after'}"


def _duration(seconds: float) -> str:
    length = abs(seconds)
    return f"{length:.0f} s" if length < 99.5 else f"{length / 60:.0f} min"
