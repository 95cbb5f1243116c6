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
from dataclasses import dataclass, replace
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.errors import Unprocessable
from shared.geometry.cameras import Camera, CameraSource, Floats
from shared.geometry.component import Component, bounded_inverse, projection_jacobian
from shared.geometry.frames import MIN_AGREEING_SHARE, Alignment, Similarity
from shared.geometry.localise import OTHER_LENS, LocalPose, localise
from shared.geometry.radius import (
    NORMAL_95,
    PoseCalibration,
    heading_sigma,
    horizontal_sigma,
    normal_radii,
)
from shared.matching.features import WORKING_SIDE, LocalFeatures

CANDIDATES = 10
NEIGHBOUR_SECONDS = 2.0
MAX_PHOTOS = 300
"""Localised for a calibration: of so many, an interval of 68 % is known to 5 percentage points"""
DISAGREEING_SIGMAS = 3.5
"""Rayleigh: 1 of 450 photos with right coordinates is farther off"""
AROUND = 8
"""Photos around one with other coordinates, most of which must agree with the model"""
MIN_SIGMA_M = 1.0
"""Least standard deviation of coordinates in each direction"""
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

    photo_id: str
    latitude: float
    """when it was reconstructed"""
    longitude: float
    proposed_latitude: float
    proposed_longitude: float
    distance_m: float
    radius_95_m: float
    """of the proposed ones: with the errors of the alignment and of the photos that agree"""


@dataclass(frozen=True, slots=True, eq=False)
class ComponentPhotos:
    """A component with what its photos are localised with."""

    component: Component
    features: Mapping[UUID, LocalFeatures]
    """of the component's photos"""
    descriptors: NDArray[np.float32]
    """(n, D) L2-normalised, of the component's photos in their order"""
    seconds: Floats
    """(n,) when they were taken; NaN where that is unknown"""
    focal_lengths: Sequence[float | None]
    """(n,) of EXIF, as multiples of the longer side; None without. With one, the camera of a query
    is that of the model, unless it was imported without a key"""
    similarity: Similarity | None
    """of the component, if it is aligned"""

    def is_camera_known(self, row: int) -> bool:
        """Return whether a query of the same camera as a photo would get its camera."""
        rays = self.component.cameras[self.component.camera_numbers[row]].rays
        known = self.focal_lengths[row] if rays is None else any(rays.camera_key)
        return bool(known)

    def query_camera(self, row: int, knows_lens: bool) -> tuple[Camera | None, CameraSource]:
        """Return what is known of the camera of a query with a photo's EXIF."""
        camera = self.component.cameras[self.component.camera_numbers[row]]
        features = self.features[self.component.photo_ids[row]]
        size, focal_length = (features.width, features.height), self.focal_lengths[row]
        if knows_lens:
            return camera.resized(*size), CameraSource.MAP
        if focal_length is None:
            return None, CameraSource.ESTIMATED
        return Camera.of_focal_length(*size, focal_length), CameraSource.EXIF


def localise_left_out(
    photos: ComponentPhotos,
    on_progress: Callable[[int], None],
    threads: int = min(os.cpu_count() or 1, 4),
    *,
    knows_lens: bool = False,
) -> list[LeftOutPose | None]:
    """Localise at most MAX_PHOTOS photos of a component without themselves; None without a pose.

    Args:
        knows_lens: As queries of the photos' own cameras: photos whose camera the map would not
            recognise are left out. Otherwise as queries of other cameras.
        on_progress: Called with the number of photos that are done; what it raises ends the work.
    """
    component, features, descriptors = photos.component, photos.features, photos.descriptors
    seconds = photos.seconds
    count = len(component.photo_ids)
    chosen = np.sort(np.random.default_rng(0).permutation(count)[:MAX_PHOTOS])
    if knows_lens:
        chosen = chosen[[photos.is_camera_known(row) for row in chosen]]

    def localise_one(row: int) -> LeftOutPose | None:
        near = np.abs(seconds - seconds[row]) <= NEIGHBOUR_SECONDS
        near[row] = True
        similarities = np.where(near, -np.inf, descriptors @ descriptors[row])
        best = np.argsort(-similarities, kind="stable")[: min(CANDIDATES, int((~near).sum()))]
        photo = component.photo_ids[row]
        try:
            found = localise(
                _as_another_photo(component, row, features[photo], by_another_lens=not knows_lens),
                [(component.photo_ids[i], features[component.photo_ids[i]]) for i in best.tolist()],
                [_without(component, np.flatnonzero(near), features)],
                *photos.query_camera(row, knows_lens),
                frozenset(component.photo_ids[i] for i in np.flatnonzero(near).tolist()),
            )
        except Unprocessable:
            return None
        return _compare(component, row, found, photos.similarity)

    done: list[LeftOutPose | None] = []
    with ThreadPoolExecutor(threads, "calibrate") as pool:
        for found in pool.map(localise_one, chosen.tolist()):
            done.append(found)
            on_progress(len(done))
    return done


def _errors(
    component: Component, row: int, features: LocalFeatures
) -> tuple[NDArray[np.int32], Floats]:
    """Return the points that a photo sees, and (m, 2) how far its keypoints are from them.

    In pixels at WORKING_SIDE, undistorted. Keypoints whose ray the camera does not know are left
    out.
    """
    numbers = component.point_numbers[row]
    camera, is_point = component.cameras[component.camera_numbers[row]], numbers >= 0
    seen = component.points[numbers[is_point]] @ component.rotation(row).T
    pixels = camera.undistort(features.pixels()[is_point])
    errors = pixels - camera.project(seen + component.translations[row])
    is_known = np.isfinite(errors).all(axis=1)
    scale = WORKING_SIDE / max(camera.width, camera.height)
    return numbers[is_point][is_known], errors[is_known] * scale


def _as_another_photo(
    component: Component, row: int, features: LocalFeatures, *, by_another_lens: bool
) -> LocalFeatures:
    """Return a photo's features as those of another photo from the same place.

    The noise of its keypoints is in its pose in the model, too, and would cancel out. So each gets
    another one of the same size. So would the errors of its lens, from which another one differs
    by `OTHER_LENS`.
    """
    random = np.random.default_rng(row)
    size = features.width, features.height
    camera = component.cameras[component.camera_numbers[row]].resized(*size)
    _, errors = _errors(component, row, features)
    pixels, longer = features.pixels(), max(size)
    if len(errors):
        noise = np.sqrt(np.mean(errors**2)) * longer / WORKING_SIDE
        pixels += random.normal(0, noise, pixels.shape)
    if by_another_lens:
        shift = random.normal(0, OTHER_LENS.principal_point * longer, 2)
        offsets = camera.undistort(pixels) - np.array(size) / 2
        squares = np.sum(offsets**2, axis=1, keepdims=True) / camera.focal_pixels**2
        bent = 1 + random.normal(0, OTHER_LENS.radial) * squares
        pixels = np.array(size) / 2 + bent * offsets + shift
    return features.moved_to(pixels)


def _without(
    component: Component, rows: NDArray[np.intp], features: Mapping[UUID, LocalFeatures]
) -> Component:
    """Return the component with its points where they would be without the keypoints of photos.

    A point is moved by one Gauss-Newton step from where all keypoints have it; cameras stay.
    """
    removed = np.zeros((len(component.points), 3, 3))
    gradients = np.zeros((len(component.points), 3))
    for row in rows.tolist():
        seen, errors = _errors(component, row, features[component.photo_ids[row]])
        jacobian = projection_jacobian(
            component.points[seen],
            component.rotation(row),
            component.translations[row],
            component.cameras[component.camera_numbers[row]].focal_length * WORKING_SIDE,
        )
        np.add.at(removed, seen, jacobian.transpose(0, 2, 1) @ jacobian)
        np.add.at(gradients, seen, np.einsum("mij,mi->mj", jacobian, errors))
    changed = np.flatnonzero(removed.any(axis=(1, 2)))
    covariances, points = component.covariances.copy(), component.points.copy()
    left = np.linalg.inv(covariances[changed].astype(float)) - removed[changed]
    inverse = bounded_inverse(left)
    covariances[changed] = inverse
    points[changed] -= np.einsum("pij,pj->pi", inverse, gradients[changed])
    return replace(component, points=points, covariances=covariances)


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

    The expected deviation is that of the pose's covariance and the median one of all, which stands
    for errors that neighbouring points share: more points do not lessen them.
    They are those of split conformal prediction (Vovk et al. 2005): of n errors the one at
    ceil((n + 1) * level), so that a new photo's error is below it with that probability. Without
    enough poses for a level, the largest error counts, and at least the quantile of a normal
    distribution.
    """
    found = [pose for pose in poses if pose is not None]
    position_floor, heading_floor = (
        float(np.median(sigmas)) if found else 0.0
        for sigmas in ([p.distance_sigma for p in found], [p.heading_sigma for p in found])
    )
    distances = np.sort([p.distance / math.hypot(p.distance_sigma, position_floor) for p in found])
    headings = np.sort([p.heading / math.hypot(p.heading_sigma, heading_floor) for p in found])
    return PoseCalibration(
        position_floor=position_floor,
        heading_floor=heading_floor,
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


def calibrate_components(
    parts: Sequence[ComponentPhotos], on_progress: Callable[[float], None]
) -> list[PoseCalibration]:
    """Calibrate the poses in each component, of queries by other lenses and by those of the map.

    Args:
        on_progress: Called with the share of the photos of all components that are done.
    """
    counts = [min(len(part.component.photo_ids), MAX_PHOTOS) for part in parts]
    done = 0

    def report(of_part: int) -> None:
        on_progress((done + of_part) / (2 * sum(counts)))

    found: list[PoseCalibration] = []
    for part, count in zip(parts, counts, strict=True):
        any_lens = calibrate(localise_left_out(part, report))
        done += count
        known = localise_left_out(part, report, knows_lens=True)
        done += count
        found.append(
            any_lens.model_copy(update={"known_lens": calibrate(known) if known else None})
        )
    return found


def propose_coordinates(
    component: Component, alignment: Alignment, latitudes: Floats, longitudes: Floats
) -> list[CoordinateProposal]:
    """Return proposals for the photos that are farther from their coordinates than the others.

    A group of photos that are off together may be joined wrongly to the model. So there is a
    proposal only where most photos around agree with the model: those around the photo in the
    model, and those around its coordinates.

    Args:
        alignment: Of the component with the coordinates of its photos, in their order.
        latitudes, longitudes: (n,) degrees of these; NaN without coordinates.
    """
    proposals = []
    similarity, centres = alignment.similarity, component.centres()
    sigma_m = max(MIN_SIGMA_M, alignment.rms_m / math.sqrt(2))
    covariances = [similarity.position_covariance(centre) for centre in centres]
    sigmas_m = np.sqrt([sigma_m**2 + float(np.trace(c[:2, :2])) / 2 for c in covariances])
    agrees = alignment.residuals_m <= DISAGREEING_SIGMAS * sigmas_m
    modelled = similarity.apply(centres)[:, :2]
    own = alignment.origin.from_geographic(latitudes, longitudes, np.zeros(len(centres)))[:, :2]
    for row in np.flatnonzero(np.isfinite(alignment.residuals_m) & ~agrees).tolist():
        shares = []
        for places in (modelled, own):
            distances = np.linalg.norm(places - places[row], axis=1)
            distances[row] = np.nan
            distances[np.isnan(alignment.residuals_m)] = np.nan
            around = np.argsort(distances)[: min(AROUND, int(np.isfinite(distances).sum()))]
            shares.append(float(np.mean(agrees[around])))
        if min(shares) < MIN_AGREEING_SHARE:
            continue
        place = alignment.origin.to_geographic(similarity.apply(centres[row]))
        proposals.append(
            CoordinateProposal(
                str(component.photo_ids[row]),
                float(latitudes[row]),
                float(longitudes[row]),
                place.latitude,
                place.longitude,
                float(alignment.residuals_m[row]),
                math.hypot(normal_radii(covariances[row])[1], NORMAL_95[1] * alignment.rms_m),
            )
        )
    return proposals
