"""Radii of poses: the covariance of a pose, scaled by what the map's own photos show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from shared.geometry.cameras import CameraSource, Floats
from shared.geometry.component import quaternion_of
from shared.geometry.frames import Attitude, EastNorthUp, Similarity, attitude_of, geopose_rotation
from shared.geometry.localise import OTHER_LENS, LocalPose

CAMERA_MODEL_SIGMA = 0.0025
"""radians by which rays are off together, beyond what the covariance of a pose says: of a model
whose focal length is wrong by 0.7 %, or its principal point by 0.2 % of the longer side"""
NORMAL_68 = (1.0, 1.067)
NORMAL_95 = (1.96, 1.731)
"""Quantiles of the length of a normal vector over its root mean square: in one dimension, and in
two of the same standard deviation"""
NORMAL_OF_ANGLE = (0.994, 1.96)
"""at 68 and 95 %"""


class PoseCalibration(BaseModel):
    """How far poses are off, compared with their covariance: quantiles over left-out photos."""

    model_config = ConfigDict(frozen=True)

    position_68: float = Field(gt=0)
    """error of the position over its standard deviation, to which the floor is added in square"""
    position_95: float = Field(gt=0)
    heading_68: float = Field(gt=0)
    heading_95: float = Field(gt=0)
    position_floor: float = Field(0.0, ge=0)
    """standard deviation, in units of the component, of errors that points have in common"""
    heading_floor: float = Field(0.0, ge=0)
    """the same of the heading, in radians"""
    share_found: float = Field(ge=0, le=1)
    """of the left-out photos that were found"""
    poses: int = Field(ge=0)
    """found; with fewer than 40 the quantiles are hardly more than a guess"""
    known_lens: PoseCalibration | None = None
    """of photos whose lens is known, by the map or exactly; the others hold for any lens"""


@dataclass(frozen=True, slots=True)
class GeoPose:
    """A pose on the earth with calibrated radii."""

    latitude: float
    longitude: float
    altitude_m: float | None
    """None if the map's photos have no altitudes"""
    attitude: Attitude
    quaternion: tuple[float, float, float, float]
    """w, x, y, z of `geopose_rotation`"""
    radius_68_m: float
    radius_95_m: float
    heading_68_degrees: float
    heading_95_degrees: float


def geo_pose(
    pose: LocalPose, origin: EastNorthUp, similarity: Similarity, calibration: PoseCalibration
) -> GeoPose:
    """Return a pose on the earth.

    The square of a radius is the sum of that of the pose in its component, the calibrated quantile
    times its standard deviation, that of the alignment at its position, and that of the camera
    model, which moves no camera of the map. Heading, pitch and roll are relative to north and up at
    the position, not at the origin.
    """
    is_of_map = pose.camera_source == CameraSource.MAP
    if is_of_map or pose.camera.rays is not None:
        calibration = calibration.known_lens or calibration
    place = origin.to_geographic(similarity.apply(pose.position))
    # From the plane at the position to that at the origin.
    turn = origin.axes @ place.axes.T
    rotation = pose.rotation @ similarity.rotation.T @ turn
    to_enu = turn.T @ similarity.rotation
    sigma = similarity.scale * math.hypot(
        horizontal_sigma(pose.covariance, to_enu), calibration.position_floor
    )
    shift = 0.0
    if len(pose.seen_points) and not is_of_map:
        # The map's own cameras share the errors of the model, which cancel out.
        depths = (pose.seen_points - pose.position) @ pose.rotation[2]
        shift = CAMERA_MODEL_SIGMA * similarity.scale * float(np.median(depths))
    aligned_68, aligned_95 = normal_radii(
        similarity.position_covariance(pose.position) + np.eye(3) * shift**2
    )
    heading = math.hypot(
        heading_sigma(pose.covariance, pose.rotation, to_enu), calibration.heading_floor
    )
    jacobian = _heading_jacobian(rotation) @ turn.T
    turned = float(jacobian @ similarity.covariance[:3, :3] @ jacobian)
    off_axis = CAMERA_MODEL_SIGMA
    if is_of_map and pose.camera.rays is None:
        # What a camera of the map has beside its middle is in the turn of all its photos.
        off_axis = OTHER_LENS.principal_point / pose.camera.focal_length
    turned = math.sqrt(turned + similarity.drift_radians**2 + off_axis**2)
    degrees = [
        math.degrees(math.hypot(factor * heading, normal * turned))
        for factor, normal in zip(
            (calibration.heading_68, calibration.heading_95), NORMAL_OF_ANGLE, strict=True
        )
    ]
    return GeoPose(
        place.latitude,
        place.longitude,
        place.altitude_m if similarity.knows_altitude else None,
        attitude_of(rotation),
        tuple(quaternion_of(geopose_rotation(rotation)).tolist()),
        math.hypot(calibration.position_68 * sigma, aligned_68),
        math.hypot(calibration.position_95 * sigma, aligned_95),
        min(180.0, degrees[0]),
        min(180.0, degrees[1]),
    )


def normal_radii(covariance: Floats) -> tuple[float, float]:
    """Return the radii that hold 68 and 95 % of horizontal errors, in the unit of the covariance.

    Between errors along a line and those of all directions, the quantiles are interpolated by the
    ratio of the standard deviations: within 2 % of the exact ones.

    Args:
        covariance: (3, 3) in east-north-up.
    """
    least, greatest = np.linalg.eigvalsh(covariance[:2, :2])
    ratio = math.sqrt(max(0.0, least) / greatest) if greatest > 0 else 1.0
    sigma = math.sqrt(max(0.0, least + greatest))
    radius_68, radius_95 = (
        sigma * (line + ratio * (disc - line)) for line, disc in (NORMAL_68, NORMAL_95)
    )
    return radius_68, radius_95


def horizontal_sigma(covariance: Floats, rotation: Floats | None) -> float:
    """Return the root mean square of the horizontal error of a pose, in units of its component.

    Args:
        covariance: (6, 6) of `LocalPose`.
        rotation: (3, 3) from the component to east-north-up; None if it is not aligned: then the
            error counts in all three dimensions.
    """
    if rotation is None:
        return math.sqrt(float(np.trace(covariance[:3, :3])))
    return math.sqrt(float(np.trace((rotation @ covariance[:3, :3] @ rotation.T)[:2, :2])))


def heading_sigma(covariance: Floats, rotation: Floats, to_enu: Floats | None) -> float:
    """Return the standard deviation of a pose's heading in radians.

    Args:
        covariance: (6, 6) of `LocalPose`.
        rotation: (3, 3) from the component to the camera's axes.
        to_enu: (3, 3) from the component to east-north-up; None if it is not aligned: then it is
            that of a turn about the camera's y axis.
    """
    jacobian = rotation[1]
    if to_enu is not None:
        jacobian = _heading_jacobian(rotation @ to_enu.T) @ to_enu
    return math.sqrt(float(jacobian @ covariance[3:, 3:] @ jacobian))


def _heading_jacobian(rotation: Floats) -> Floats:
    """Return the (3,) derivatives of the heading by a turn of the camera in east-north-up."""
    east, north, up = rotation[2]
    square = max(east**2 + north**2, 1e-12)
    # A turn t changes the direction of view, f, by t x f.
    found: Floats = np.array([up * east, up * north, -square]) / square
    return found
