"""Localising a photo in a model: matches with its best photos, a robust pose, and its gates."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.errors import Unprocessable
from shared.geometry.absolute_pose import AbsolutePose, LensSigmas, estimate_absolute_pose
from shared.geometry.cameras import Camera, CameraSource, Floats
from shared.geometry.component import Component
from shared.matching.features import LocalFeatures
from shared.matching.mutual_nearest import match_keypoints

MIN_INLIERS = 30
MIN_INLIER_SHARE = 0.25
"""of the keypoints that match a point"""
MIN_EXTENT = 0.03
"""Standard deviation of the inliers across their line, as a share of the longer side"""
MAX_SIGMA_OF_DEPTH = 0.2
"""Largest standard deviation of a position as a share of the distance to what is seen"""
MAX_DEPTHS = 3.0
"""Largest distance from the photos that were matched, in distances to what is seen"""
MIN_COMMON_POINTS = 5
"""Photos that see as many points in common show the same place"""
MAX_PLACES = 3
RIVAL_SHARE = 0.6
"""A place with such a share of the best one's inliers explains the photo about equally well"""
SAME_POSE_DEPTHS, SAME_POSE_COSINE = 0.3, 0.9
"""Two poses are the same within this share of the distance to what is seen, and 26 degrees"""
PANORAMA_RATIO = 1.95
PLAUSIBLE_FOCAL_LENGTHS = (0.35, 4.0)
FOCAL_SIGMAS = {CameraSource.GIVEN: 0.01, CameraSource.EXIF: 0.04, CameraSource.MAP: 0.01}
"""Relative standard deviation of a focal length by its source"""
MAP_LENS = LensSigmas(principal_point=0.0025, radial=0.02)
"""of a camera whose photos are in the map"""
OTHER_LENS = LensSigmas(principal_point=0.005, radial=0.05)
"""of any other: the axes of real lenses are 0.3 to 1.5 % of the longer side beside the middle"""
FOCAL_TIE = 1.1
"""Another focal length contradicts only if it explains so many times as many keypoints"""
MAX_FOCAL_SIGMAS = 4.0
"""Farther off, a focal length contradicts the one that the matches show"""


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
    """keypoints of which a point agrees with the pose"""
    matches: int
    """keypoints that match a point"""
    camera: Camera
    camera_source: CameraSource
    seen_points: Floats
    """(m, 3) in the frame"""
    seen_pixels: Floats
    """(m, 2) where they are in the photo"""


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Keypoints of the query with the points of one component that they may be."""

    component: int
    photos: tuple[int, ...]
    """rows of the photos that they were matched with"""
    keypoint_numbers: NDArray[np.int32]
    pixels: Floats
    point_numbers: NDArray[np.int32]

    def keypoints(self, pose: AbsolutePose) -> int:
        """Return how many keypoints are inliers, each of which may be a part of several pairs."""
        return len(np.unique(self.keypoint_numbers[pose.is_inlier]))


def localise(
    query: LocalFeatures,
    candidates: Sequence[tuple[UUID, LocalFeatures]],
    components: Sequence[Component],
    camera: Camera | None,
    camera_source: CameraSource,
    leave_out: AbstractSet[UUID] = frozenset(),
) -> LocalPose:
    """Return the pose of a photo; Unprocessable (`no_pose`) says why it has none.

    Args:
        query: Local features of the photo.
        candidates: Photos that may show the same place, best first, with their features, which are
            those that the components were made of.
        components: Of the model.
        camera: The camera of the photo, at its size; None if its focal length is unknown.
        camera_source: Where `camera` comes from; ESTIMATED without one.
        leave_out: Photos that are treated as if they were not in the components.
    """
    longer, shorter = max(query.width, query.height), min(query.width, query.height)
    if longer >= PANORAMA_RATIO * shorter and camera_source != CameraSource.GIVEN:
        raise Unprocessable(
            "no_pose", "The photo has the shape of a panorama, which no pinhole camera takes."
        )
    places = _candidates_in(components, candidates, leave_out)
    if not places:
        raise Unprocessable("no_pose", "None of the best photos of the map is in the model.")
    pixels = query.pixels() if camera is None else camera.undistort(query.pixels())
    groups = [
        _match(query, pixels, group, components, leave_out)
        for group in _group_by_place(places, components)
    ]
    groups = sorted(groups, key=lambda pairs: -len(pairs.pixels))[:MAX_PLACES]
    source = camera_source if camera else CameraSource.ESTIMATED
    tried = camera or Camera.of_focal_length(query.width, query.height, 1.0)
    found = [
        (pairs, pose) for pairs in groups if (pose := _estimate(pairs, components, tried, source))
    ]
    found.sort(key=lambda each: -each[0].keypoints(each[1]))
    count = found[0][0].keypoints(found[0][1]) if found else 0
    if count < MIN_INLIERS:
        raise Unprocessable(
            "no_pose",
            f"{count} points of the model agree with one position of the camera, and {MIN_INLIERS} "
            "are needed.",
        )
    pairs, pose = found[0]
    reason = _doubt(pairs, pose, components, found[1:])
    if not reason and source in FOCAL_SIGMAS:
        reason = _doubt_focal_length(pairs, pose, components, source)
    if reason:
        raise Unprocessable("no_pose", reason)
    return LocalPose(
        pairs.component,
        pose.rotation,
        pose.position,
        pose.covariance,
        count,
        len(np.unique(pairs.keypoint_numbers)),
        pose.camera,
        source,
        components[pairs.component].points[pairs.point_numbers[pose.is_inlier]],
        query.pixels()[pairs.keypoint_numbers[pose.is_inlier]],
    )


def _estimate(
    pairs: _Pairs, components: Sequence[Component], camera: Camera, source: CameraSource
) -> AbsolutePose | None:
    component, numbers = components[pairs.component], pairs.point_numbers
    covariances = component.covariances[numbers].astype(float)
    lens = MAP_LENS if source == CameraSource.MAP else OTHER_LENS
    return estimate_absolute_pose(
        pairs.pixels,
        component.points[numbers],
        camera,
        FOCAL_SIGMAS.get(source),
        covariances,
        lens if camera.rays is None else None,
    )


def _doubt(
    pairs: _Pairs,
    pose: AbsolutePose,
    components: Sequence[Component],
    others: Sequence[tuple[_Pairs, AbsolutePose]],
) -> str | None:
    """Return why a pose may be wrong, in words."""
    count, component = pairs.keypoints(pose), components[pairs.component]
    if count < MIN_INLIER_SHARE * len(np.unique(pairs.keypoint_numbers)):
        return f"Only {count} of many matches agree with one position of the camera."
    pixels = pairs.pixels[pose.is_inlier]
    longer = max(pose.camera.width, pose.camera.height)
    if np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[1] < (
        MIN_EXTENT * longer * np.sqrt(len(pixels))
    ):
        return "The points that agree are in a small part or on a line of the photo."
    low, high = PLAUSIBLE_FOCAL_LENGTHS
    if not low <= pose.camera.focal_length <= high:
        return (
            f"The points agree with a focal length of {pose.camera.focal_length:.2f} longer sides "
            "only, which hardly a camera has."
        )
    seen = component.points[pairs.point_numbers[pose.is_inlier]] - pose.position
    depth = float(np.median(seen @ pose.rotation[2]))
    if np.sqrt(np.trace(pose.covariance[:3, :3])) > MAX_SIGMA_OF_DEPTH * depth:
        return "The points that agree leave the position of the camera open."
    centres = component.centres()[list(pairs.photos)]
    if np.linalg.norm(centres - pose.position, axis=1).min() > MAX_DEPTHS * depth:
        return "The position of the camera would be far away from the photos that it matches."
    for other, rival in others:
        is_same = (
            other.component == pairs.component
            and np.linalg.norm(rival.position - pose.position) < SAME_POSE_DEPTHS * depth
            and rival.rotation[2] @ pose.rotation[2] > SAME_POSE_COSINE
        )
        if not is_same and other.keypoints(rival) >= max(MIN_INLIERS, RIVAL_SHARE * count):
            return "Two places of the model explain the photo about equally well."
    return None


def _doubt_focal_length(
    pairs: _Pairs, pose: AbsolutePose, components: Sequence[Component], source: CameraSource
) -> str | None:
    """Return why the focal length that was used contradicts the matches, in words."""
    free = _estimate(pairs, components, pose.camera, CameraSource.ESTIMATED)
    if free is None or pairs.keypoints(free) <= FOCAL_TIE * pairs.keypoints(pose):
        return None
    used = pose.camera.focal_length
    off = abs(np.log(free.camera.focal_length / used))
    if off <= MAX_FOCAL_SIGMAS * np.hypot(free.focal_sigma, FOCAL_SIGMAS[source]):
        return None
    return (
        f"The focal length ({source}) is {used:.2f} longer sides, but the matches agree with "
        f"{free.camera.focal_length:.2f}."
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
    pixels: Floats,
    group: Sequence[tuple[int, int, LocalFeatures]],
    components: Sequence[Component],
    leave_out: AbstractSet[UUID],
) -> _Pairs:
    """Match the query with the photos of a place; each pair counts once.

    Args:
        pixels: (keypoints, 2) of the query, undistorted; NaN where the camera knows no ray.
    """
    number = group[0][0]
    component = components[number]
    is_seen = _seen_by_others(component, leave_out)
    found = [np.empty((0, 2), np.int64)]
    for _, row, features in group:
        matches = match_keypoints(query, features)
        points = component.point_numbers[row][matches[:, 1]]
        is_point = (points >= 0) & is_seen[points]
        found.append(np.column_stack([matches[is_point, 0], points[is_point]]))
    pairs = np.unique(np.concatenate(found), axis=0)
    pairs = pairs[np.isfinite(pixels[pairs[:, 0]]).all(axis=1)]
    return _Pairs(
        number,
        tuple(row for _, row, _ in group),
        pairs[:, 0].astype(np.int32),
        pixels[pairs[:, 0]],
        pairs[:, 1].astype(np.int32),
    )


def _seen_by_others(component: Component, leave_out: AbstractSet[UUID]) -> NDArray[np.bool_]:
    """Return the (p,) mask of the points that two photos see without those that are left out."""
    counts = component.observations.copy()
    for photo, numbers in zip(component.photo_ids, component.point_numbers, strict=True):
        if photo in leave_out:
            counts[numbers[numbers >= 0]] -= 1
    return counts >= 2
