"""Measures the poses of a model with its own photos, and finds wrong coordinates.

Each photo is localised as if neither it nor its neighbours in time were in the map. Its true pose
is that of the model, so the errors are those within the model; the error of the alignment is a part
of its covariance (`shared.geometry.frames`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.geometry.cameras import Camera, CameraSource, Floats
from shared.geometry.component import Component
from shared.geometry.frames import Alignment, Similarity
from shared.geometry.localise import LocalPose, localise
from shared.geometry.radius import (
    PoseCalibration,
    heading_sigma,
    horizontal_sigma,
    normal_radii,
)
from shared.matching.features import LocalFeatures
from shared.matching.matchers import Matcher

CANDIDATES = 10
NEIGHBOUR_SECONDS = 2.0
MAX_PHOTOS = 300
"""Localised for a calibration: of so many, an interval of 68 % is known to 5 percentage points"""
DISAGREEING_SIGMAS = 3.5
"""Rayleigh: 1 of 450 photos with right coordinates is farther off"""
MIN_FACTOR = 0.1
"""Least quantile factor: a radius of 0 is nobody's"""


@dataclass(frozen=True, slots=True)
class LeftOutPose:
    """How far a photo is localised from its pose in the model, beside the expected deviation."""

    photo: UUID
    distance: float
    """in units of the component; horizontal if it is aligned"""
    distance_sigma: float
    heading: float
    """radians"""
    heading_sigma: float


@dataclass(frozen=True, slots=True)
class CoordinateProposal:
    """Coordinates that agree with the model, for a photo whose own disagree."""

    photo: UUID
    latitude: float
    longitude: float
    altitude_m: float | None
    distance_m: float
    """from the photo's coordinates"""
    radius_95_m: float
    """of the proposed ones"""


def localise_left_out(
    component: Component,
    features: Mapping[UUID, LocalFeatures],
    descriptors: NDArray[np.float32],
    seconds: Floats,
    focal_lengths: Sequence[float | None],
    matcher: Matcher,
    similarity: Similarity | None,
    on_progress: Callable[[int], None],
    threads: int = min(os.cpu_count() or 1, 4),
) -> list[LeftOutPose | None]:
    """Localise at most MAX_PHOTOS photos of a component without themselves; None without a pose.

    Args:
        features: Of the component's photos.
        descriptors: (n, D) L2-normalised, of the component's photos in their order.
        seconds: (n,) when they were taken; NaN where that is unknown.
        focal_lengths: (n,) of EXIF, as multiples of the longer side; None without.
        similarity: Of the component, if it is aligned.
        on_progress: Called with the number of photos that are done; what it raises ends the work.
    """
    count = len(component.photo_ids)
    chosen = np.sort(np.random.default_rng(0).permutation(count)[:MAX_PHOTOS])

    def localise_one(row: int) -> LeftOutPose | None:
        near = np.abs(seconds - seconds[row]) <= NEIGHBOUR_SECONDS
        near[row] = True
        similarities = np.where(near, -np.inf, descriptors @ descriptors[row])
        best = np.argsort(-similarities, kind="stable")[: min(CANDIDATES, int((~near).sum()))]
        photo = component.photo_ids[row]
        query = features[photo]
        camera, source = _query_camera(component, row, query, focal_lengths[row])
        found = localise(
            query,
            [(component.photo_ids[i], features[component.photo_ids[i]]) for i in best.tolist()],
            [component],
            camera,
            source,
            matcher,
            frozenset(component.photo_ids[i] for i in np.flatnonzero(near).tolist()),
        )
        return _compare(component, row, found, similarity) if isinstance(found, LocalPose) else None

    done: list[LeftOutPose | None] = []
    with ThreadPoolExecutor(threads, "calibrate") as pool:
        for found in pool.map(localise_one, chosen.tolist()):
            done.append(found)
            on_progress(len(done))
    return done


def _query_camera(
    component: Component, row: int, query: LocalFeatures, focal_length: float | None
) -> tuple[Camera | None, CameraSource]:
    """Return the camera that a query of the same camera as a photo would have."""
    camera = component.cameras[component.camera_numbers[row]]
    if camera.rays is not None and any(camera.rays.camera_key):
        return camera.resized(query.width, query.height), CameraSource.MAP
    if focal_length is None:
        return None, CameraSource.ESTIMATED
    camera = Camera.of_focal_length(query.width, query.height, focal_length)
    return camera, CameraSource.EXIF


def _compare(
    component: Component, row: int, found: LocalPose, similarity: Similarity | None
) -> LeftOutPose:
    rotation = component.rotation(row)
    error = found.position - component.centres()[row]
    to_enu = None if similarity is None else similarity.rotation
    # The turn of the camera in the component's frame, as the covariance has it
    turn = found.rotation.T @ rotation
    vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = rotation[1] if to_enu is None else to_enu[2]
    if to_enu is not None:
        error = (to_enu @ error)[:2]
    return LeftOutPose(
        component.photo_ids[row],
        float(np.linalg.norm(error)),
        horizontal_sigma(found.covariance, to_enu),
        math.asin(min(1.0, abs(float(vector @ axis)) / 2)),
        heading_sigma(found.covariance, found.rotation, to_enu),
    )


def calibrate(poses: Sequence[LeftOutPose | None]) -> PoseCalibration:
    """Return the conformal quantiles of the errors over their expected deviations.

    They are those of split conformal prediction (Vovk et al. 2005): of n errors the one at
    ceil((n + 1) * level), so that a new photo's error is below it with that probability. Without
    enough poses for a level, the largest error counts, and at least the quantile of a normal
    distribution.
    """
    found = [pose for pose in poses if pose is not None]
    distances = np.sort([pose.distance / pose.distance_sigma for pose in found])
    headings = np.sort([pose.heading / pose.heading_sigma for pose in found])
    return PoseCalibration(
        position_68=_quantile(distances, 0.68, 1.0),
        position_95=_quantile(distances, 0.95, 1.96),
        heading_68=_quantile(headings, 0.68, 1.0),
        heading_95=_quantile(headings, 0.95, 1.96),
        share_found=len(found) / max(1, len(poses)),
        poses=len(found),
    )


def _quantile(ratios: Floats, level: float, normal: float) -> float:
    place = math.ceil((len(ratios) + 1) * level)
    if place <= len(ratios):
        return max(MIN_FACTOR, float(ratios[place - 1]))
    return max(normal, float(ratios[-1]) if len(ratios) else normal)


@dataclass(frozen=True, slots=True, eq=False)
class ComponentPhotos:
    """A component with the arguments of `localise_left_out`."""

    component: Component
    features: Mapping[UUID, LocalFeatures]
    descriptors: NDArray[np.float32]
    seconds: Floats
    focal_lengths: Sequence[float | None]
    similarity: Similarity | None


def calibrate_components(
    parts: Sequence[ComponentPhotos], matcher: Matcher, on_progress: Callable[[int], None]
) -> list[PoseCalibration]:
    """Calibrate the poses in each component.

    Args:
        on_progress: Called with the number of photos of all components that are done.
    """
    found: list[PoseCalibration] = []
    done = 0

    def report(count: int) -> None:
        on_progress(done + count)

    for part in parts:
        poses = localise_left_out(
            part.component,
            part.features,
            part.descriptors,
            part.seconds,
            part.focal_lengths,
            matcher,
            part.similarity,
            report,
        )
        done += len(poses)
        found.append(calibrate(poses))
    return found


def propose_coordinates(
    component: Component, alignment: Alignment, sigmas_m: Floats
) -> list[CoordinateProposal]:
    """Return proposals for the photos that are farther from their coordinates than expected.

    Args:
        alignment: Of the component with the coordinates of its photos, in their order.
        sigmas_m: (n,) expected standard deviation of the coordinates in each direction.
    """
    proposals = []
    similarity = alignment.similarity
    for row, centre in enumerate(component.centres()):
        distance_m = float(alignment.residuals_m[row])
        covariance = similarity.position_covariance(centre)
        variance = sigmas_m[row] ** 2 + float(np.trace(covariance[:2, :2])) / 2
        if not distance_m > DISAGREEING_SIGMAS * math.sqrt(variance):
            continue
        place = alignment.origin.to_geographic(similarity.apply(centre))
        proposals.append(
            CoordinateProposal(
                component.photo_ids[row],
                place.latitude,
                place.longitude,
                place.altitude_m if similarity.knows_altitude else None,
                distance_m,
                normal_radii(covariance)[1],
            )
        )
    return proposals
