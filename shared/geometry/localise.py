"""Localising a photo in a model: matches with its best photos, a robust pose, and its gates."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.geometry.absolute_pose import AbsolutePose, estimate_absolute_pose
from shared.geometry.cameras import Camera, CameraSource, Floats
from shared.geometry.component import Component
from shared.matching.features import LocalFeatures
from shared.matching.matchers import Matcher

MIN_INLIERS = 12
MIN_COMMON_POINTS = 5
"""Photos that see as many points in common show the same place"""
FOCAL_SIGMAS = {CameraSource.GIVEN: 0.01, CameraSource.EXIF: 0.04, CameraSource.MAP: 0.05}
"""Relative standard deviation of a focal length by its source"""


@dataclass(frozen=True, slots=True)
class LocalPose:
    """The pose of a photo in the frame of a component."""

    component: int
    """its number in the sequence of components"""
    rotation: Floats
    """(3, 3) from the frame to the camera's axes"""
    position: Floats
    """(3,) of the camera's centre"""
    covariance: Floats
    """(6, 6) of the centre, and of a turn of the camera in the frame (radians)"""
    inliers: int
    """pairs of a keypoint and a point that agree with the pose"""
    matches: int
    """all pairs"""
    camera: Camera
    camera_source: CameraSource
    seen_points: Floats
    """(inliers, 3) in the frame"""
    seen_pixels: Floats
    """(inliers, 2) where they are in the photo"""


@dataclass(frozen=True, slots=True)
class NoPose:
    """Why a photo has no pose."""

    reason: str
    """a sentence"""


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Keypoints of the query with the points of one component that they may be."""

    component: int
    photos: tuple[int, ...]
    """rows of the photos that they were matched with"""
    pixels: Floats
    point_numbers: NDArray[np.int32]


def localise(
    query: LocalFeatures,
    candidates: Sequence[tuple[UUID, LocalFeatures]],
    components: Sequence[Component],
    camera: Camera | None,
    camera_source: CameraSource,
    matcher: Matcher,
    leave_out: AbstractSet[UUID] = frozenset(),
) -> LocalPose | NoPose:
    """Return the pose of a photo, or the reason why it has none.

    Args:
        query: Local features of the photo.
        candidates: Photos that may show the same place, best first, with their features, which are
            those that the components were made of.
        components: Of the model.
        camera: The camera of the photo, at its size; None if its focal length is unknown.
        camera_source: Where `camera` comes from; ESTIMATED without one.
        matcher: For features of this model.
        leave_out: Photos that are treated as if they were not in the components.
    """
    places = _candidates_in(components, candidates, leave_out)
    if not places:
        return NoPose("None of the best photos of the map is in the model.")
    groups = [
        _match(query, group, components, matcher, leave_out)
        for group in _group_by_place(places, components)
    ]
    groups = sorted(groups, key=lambda pairs: -len(pairs.pixels))
    if not len(groups[0].pixels):
        return NoPose("The photo has no matches with points of the model.")
    focal_sigma = FOCAL_SIGMAS.get(camera_source) if camera else None
    tried = camera or Camera.of_focal_length(query.width, query.height, 1.0)
    best: tuple[_Pairs, AbsolutePose] | None = None
    for pairs in groups:
        component = components[pairs.component]
        found = estimate_absolute_pose(
            pairs.pixels,
            component.points[pairs.point_numbers],
            tried,
            focal_sigma,
            component.covariances[pairs.point_numbers].astype(float),
        )
        if found and (best is None or found.is_inlier.sum() > best[1].is_inlier.sum()):
            best = pairs, found
    if best is None or best[1].is_inlier.sum() < MIN_INLIERS:
        count = int(best[1].is_inlier.sum()) if best else 0
        return NoPose(
            f"{count} points of the model agree with one position of the camera, and {MIN_INLIERS} "
            "are needed."
        )
    pairs, found = best
    return LocalPose(
        pairs.component,
        found.rotation,
        found.position,
        found.covariance,
        int(found.is_inlier.sum()),
        len(pairs.pixels),
        found.camera,
        camera_source if camera else CameraSource.ESTIMATED,
        components[pairs.component].points[pairs.point_numbers[found.is_inlier]],
        pairs.pixels[found.is_inlier],
    )


def _candidates_in(
    components: Sequence[Component],
    candidates: Sequence[tuple[UUID, LocalFeatures]],
    leave_out: AbstractSet[UUID],
) -> list[tuple[int, int, LocalFeatures]]:
    """Return component, row and features of each candidate in each component that has it."""
    rows = [{photo: row for row, photo in enumerate(c.photo_ids)} for c in components]
    return [
        (number, rows[number][photo], features)
        for photo, features in candidates
        for number, component in enumerate(components)
        if photo not in leave_out
        and photo in rows[number]
        and len(component.point_numbers[rows[number][photo]]) == len(features.positions)
    ]


def _group_by_place(
    places: Sequence[tuple[int, int, LocalFeatures]], components: Sequence[Component]
) -> list[list[tuple[int, int, LocalFeatures]]]:
    """Group photos that see points in common, directly or through others of them."""
    groups: list[tuple[set[int], list[tuple[int, int, LocalFeatures]]]] = []
    for place in places:
        seen = set(components[place[0]].point_numbers[place[1]].tolist()) - {-1}
        joined = [
            group
            for group in groups
            if group[1][0][0] == place[0] and len(group[0] & seen) >= MIN_COMMON_POINTS
        ]
        members = [place]
        for group in joined:
            seen |= group[0]
            members = [*group[1], *members]
            groups.remove(group)
        groups.append((seen, members))
    return [members for _, members in groups]


def _match(
    query: LocalFeatures,
    group: Sequence[tuple[int, int, LocalFeatures]],
    components: Sequence[Component],
    matcher: Matcher,
    leave_out: AbstractSet[UUID],
) -> _Pairs:
    """Match the query with the photos of a place; each pair counts once."""
    number = group[0][0]
    component = components[number]
    is_seen = _seen_by_others(component, leave_out)
    found = [np.empty((0, 2), np.int64)]
    for _, row, features in group:
        matches = matcher.match(query, features)
        points = component.point_numbers[row][matches[:, 1]]
        is_point = (points >= 0) & is_seen[points]
        found.append(np.column_stack([matches[is_point, 0], points[is_point]]))
    pairs = np.unique(np.concatenate(found), axis=0)
    return _Pairs(
        number,
        tuple(row for _, row, _ in group),
        query.pixels()[pairs[:, 0]],
        pairs[:, 1].astype(np.int32),
    )


def _seen_by_others(component: Component, leave_out: AbstractSet[UUID]) -> NDArray[np.bool_]:
    """Return the (p,) mask of the points that two photos see without those that are left out."""
    counts = component.observations.copy()
    for photo, numbers in zip(component.photo_ids, component.point_numbers, strict=True):
        if photo in leave_out:
            counts[numbers[numbers >= 0]] -= 1
    return counts >= 2
