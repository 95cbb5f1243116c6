"""State of a track: position or place, levels and status, from a belief."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from shared.evaluation.places.levels import CandidateLevel, LevelScheme
from shared.evaluation.places.probability import error_radius_m
from shared.geodesy import weighted_centroid
from shared.place_paths import label_levels
from shared.tracks.belief import Belief, TrackStatus
from shared.tracks.photo_graph import FloatArray, PhotoTable, distance_matrix_m

TRACKING_PROBABILITY = 0.8
"""From here on the place is tracked; a track is lost below 1/2"""
KEPT_PROBABILITY = 0.5
DIRECTION_ODDS = 3.0
"""Log-odds that a camera moves along the map's sequence at which it is as probable as not: where
descriptors mislead for many frames, the place stands still or moves as well backwards"""
CENTERS = 100
"""Number of most probable photos that the best place is chosen among"""


@dataclass(frozen=True, slots=True)
class TrackLevel:
    """A place that contains the camera with a probability."""

    place: str | None
    latitude: float | None
    longitude: float | None
    radius_m: float | None
    probability: float


@dataclass(frozen=True, slots=True)
class TrackState:
    """Where the camera is."""

    time: datetime
    status: TrackStatus
    photo: str | None
    """id of the map's photo that was taken nearest, None if nothing is known"""
    latitude: float | None
    longitude: float | None
    place: str | None
    heading: float | None
    """of the photo, degrees clockwise from north"""
    probability: float
    """of the finest level; without coordinates and labels, that `photo` is right or within the
    finest radius of it along its sequence"""
    levels: Sequence[TrackLevel]
    """finest first; a level is never less probable than a finer one"""
    radius_68_m: float | None
    radius_95_m: float | None
    elsewhere: float
    outside: float


def next_status(before: TrackStatus, probability: float, outside: float) -> TrackStatus:
    """Return the status after a frame, from the one before it and the new probabilities."""
    if probability >= TRACKING_PROBABILITY:
        return "tracking"
    if outside >= KEPT_PROBABILITY:
        return "lost"
    if before == "tracking" and probability < KEPT_PROBABILITY:
        return "lost"
    return before


def track_state(
    belief: Belief, photos: PhotoTable, scheme: LevelScheme, typical_speed_mps: float
) -> TrackState:
    """Compute the state of a belief.

    Args:
        photos: Those photos of the belief that are still in the map.
        scheme: The levels of the map.
        typical_speed_mps: For distances along the map's sequences.
    """
    probability_of = dict(zip(belief.photos, belief.probabilities.tolist(), strict=True))
    weights = np.array([probability_of[photo] for photo in photos.ids], dtype=np.float64)
    if not len(photos):
        return _nowhere(belief)
    by_label = scheme.labels_are_paths or bool(np.isnan(photos.latitudes[weights.argmax()]))
    labelled = by_label and any(place is not None for place in photos.places)
    if labelled:
        levels, inside = _label_levels(photos, weights, scheme)
    else:
        levels, inside = _circles(photos, weights, scheme, typical_speed_mps, belief.direction)
    best = int(np.where(inside, weights, -1.0).argmax())
    finest = levels[0]
    circles = [
        CandidateLevel(latitude=each.latitude, longitude=each.longitude, radius_m=each.radius_m)
        for each in levels
    ]
    probabilities = [each.probability for each in levels]
    heading = float(photos.headings[best])
    return TrackState(
        time=belief.time,
        status=belief.status,
        photo=photos.ids[best],
        latitude=finest.latitude,
        longitude=finest.longitude,
        place=finest.place if labelled else photos.places[best],
        heading=None if np.isnan(heading) else heading,
        probability=finest.probability,
        levels=levels if labelled or finest.latitude is not None else (),
        radius_68_m=error_radius_m(circles, probabilities, 0.68),
        radius_95_m=error_radius_m(circles, probabilities, 0.95),
        elsewhere=belief.elsewhere,
        outside=belief.outside,
    )


def follows_sequence(photos: PhotoTable) -> NDArray[np.bool_]:
    """Return (n,) whether a photo has no place but the one in its sequence."""
    follows: NDArray[np.bool_] = np.isnan(photos.latitudes) & ~np.isnan(photos.seconds)
    follows &= photos.places == None  # noqa: E711
    return follows


def _nowhere(belief: Belief) -> TrackState:
    return TrackState(
        belief.time, belief.status, None, None, None, None, None, 0.0, (), None, None,
        belief.elsewhere, belief.outside,
    )  # fmt: skip


def _circles(
    photos: PhotoTable,
    weights: FloatArray,
    scheme: LevelScheme,
    typical_speed_mps: float,
    direction: float,
) -> tuple[list[TrackLevel], np.ndarray]:
    """Return circles around the place with the most probability, and the photos of the finest."""
    radii = sorted(scheme.radii_m)
    centers = np.argsort(-weights, kind="stable")[:CENTERS]
    away = distance_matrix_m(photos.take(centers), photos, typical_speed_mps)
    best = int(((away <= radii[0]) @ weights).argmax())
    inside = away[best] <= radii[0]
    row = photos.take(centers[best : best + 1])
    if np.isnan(row.latitudes[0]):
        latitude = longitude = None
        distances = away[best]
    else:
        members = inside & ~np.isnan(photos.latitudes)
        latitude, longitude = weighted_centroid(
            photos.latitudes[members], photos.longitudes[members], weights[members] + 1e-12
        )
        center = PhotoTable.of_rows([("", latitude, longitude, None, None, None, None)])
        distances = distance_matrix_m(center, photos, typical_speed_mps)[0]
    trust = 1.0
    if follows_sequence(row)[0]:
        trust = 1 / (1 + math.exp(DIRECTION_ODDS - direction))
    levels = [
        TrackLevel(
            None,
            latitude,
            longitude,
            radius,
            trust * min(1.0, float(weights[distances <= radius].sum())),
        )
        for radius in radii
    ]
    return levels, inside


def _label_levels(
    photos: PhotoTable, weights: FloatArray, scheme: LevelScheme
) -> tuple[list[TrackLevel], np.ndarray]:
    """Return the most probable place at each level, inside the coarser one, finest first."""
    paths = [label_levels(place, scheme.labels_are_paths)[::-1] for place in photos.places]
    inside = np.array([bool(path) for path in paths])
    levels: list[TrackLevel] = []
    for depth in range(max(map(len, paths))):
        shares: dict[str, float] = {}
        for row in np.flatnonzero(inside).tolist():
            if depth < len(paths[row]):
                name = paths[row][depth]
                shares[name] = shares.get(name, 0.0) + float(weights[row])
        if not shares:
            break
        place = max(shares, key=lambda name: shares[name])
        members = np.array([depth < len(p) and p[depth] == place for p in paths]) & inside
        if levels and shares[place] < float(weights[inside].sum()) - shares[place]:
            # Where most of the probability is at labels that end here, the levels end, too.
            ended = sum(float(weights[r]) for r in np.flatnonzero(inside) if len(paths[r]) == depth)
            if ended > shares[place]:
                break
        inside = members
        levels.append(TrackLevel(place, None, None, None, min(1.0, shares[place])))
    return levels[::-1], inside
