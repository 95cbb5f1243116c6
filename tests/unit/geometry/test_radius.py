"""Poses on the earth: coordinates, attitude and radii."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shared.geometry.cameras import CameraSource
from shared.geometry.frames import EastNorthUp, Similarity, rotation_of_vector
from shared.geometry.localise import LocalPose
from shared.geometry.radius import PoseCalibration, geo_pose, normal_radii
from tests.support.reconstructed_scene import CAMERA, looking

CALIBRATION = PoseCalibration(
    position_68=2.0,
    position_95=4.0,
    heading_68=1.5,
    heading_95=3.0,
    share_found=0.9,
    poses=100,
)
EXACT = Similarity(2.0, np.eye(3), np.zeros(3), np.zeros((7, 7)), np.zeros(3))
HERE = EastNorthUp(45.0, 7.0, 200.0)


def pose_at(position: tuple[float, float, float], sigma: float = 0.1) -> LocalPose:
    centre = np.array(position)
    covariance = np.diag([sigma**2] * 3 + [0.01**2] * 3)
    return LocalPose(
        0,
        looking(centre, centre + np.array([1.0, 1.0, 0.0])),
        centre,
        covariance,
        50,
        60,
        CAMERA,
        CameraSource.GIVEN,
        np.empty((0, 3)),
        np.empty((0, 2)),
    )


def test_pose_has_coordinates_and_calibrated_radii() -> None:
    found = geo_pose(pose_at((0.0, 50.0, 1.0)), HERE, EXACT, CALIBRATION)
    assert found.latitude == pytest.approx(45 + 100 / 111_132, abs=1e-6)
    assert found.longitude == pytest.approx(7.0, abs=1e-9)
    assert found.altitude_m == pytest.approx(202, abs=0.01)
    assert found.attitude.heading == pytest.approx(45, abs=1e-3)
    sigma_m = 2.0 * 0.1 * 2**0.5
    assert found.radius_68_m == pytest.approx(2 * sigma_m)
    assert found.radius_95_m == pytest.approx(4 * sigma_m)
    assert found.heading_68_degrees == pytest.approx(np.degrees(np.hypot(0.015, 0.0025)), rel=0.01)
    assert found.heading_95_degrees > found.heading_68_degrees


def test_error_of_the_alignment_is_in_every_radius_and_grows_with_the_distance() -> None:
    turn, shift = 0.02, 3.0
    covariance = np.diag([0, 0, turn**2, shift**2, shift**2, 0, 0])
    off = replace(EXACT, covariance=covariance)
    radii = [
        geo_pose(pose_at((0.0, north, 1.0)), HERE, off, CALIBRATION).radius_95_m
        for north in (0.0, 500.0)
    ]
    local = 4 * 2.0 * 0.1 * 2**0.5
    assert radii[0] == pytest.approx(np.hypot(local, 2.448 * shift), rel=1e-3)
    assert radii[1] == pytest.approx(np.hypot(local, 1.96 * np.hypot(shift, 1000 * turn)), rel=0.02)
    exact = geo_pose(pose_at((0.0, 0.0, 1.0)), HERE, EXACT, CALIBRATION)
    found = geo_pose(pose_at((0.0, 0.0, 1.0)), HERE, off, CALIBRATION)
    assert found.heading_68_degrees > exact.heading_68_degrees + 0.5
    drifting = replace(EXACT, drift_m=5.0)
    assert geo_pose(pose_at((0.0, 0.0, 1.0)), HERE, drifting, CALIBRATION).radius_95_m > 9


@pytest.mark.parametrize("ratio", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_radii_of_normal_errors_hold_their_share(ratio: float) -> None:
    errors = np.random.default_rng(0).normal(size=(100_000, 2)) * (3.0, 3.0 * ratio)
    lengths = np.linalg.norm(errors, axis=1)
    radii = normal_radii(np.diag([9.0, 9 * ratio**2, 1.0]))
    assert [np.mean(lengths < radius) for radius in radii] == pytest.approx([0.68, 0.95], abs=0.01)


def test_heading_is_relative_to_north_at_the_position_itself() -> None:
    # From 1 km beside the pole to 1 km on its other side: north turns by 180 degrees.
    found = geo_pose(pose_at((0, 1e3, 1)), EastNorthUp(90 - 1 / 111.7, 0.0), EXACT, CALIBRATION)
    assert abs(found.longitude) == pytest.approx(180, abs=0.1)
    assert found.attitude.heading == pytest.approx(225, abs=0.1)
    assert found.attitude.pitch == pytest.approx(0, abs=0.05)


def test_pose_in_a_map_without_altitudes_has_no_altitude() -> None:
    flat = replace(EXACT, knows_altitude=False)
    assert geo_pose(pose_at((0.0, 0.0, 1.0)), HERE, flat, CALIBRATION).altitude_m is None


def test_turned_component_gives_the_same_pose() -> None:
    turn = rotation_of_vector(np.array([1.0, 0.4, -2.0]))
    pose = pose_at((3.0, 20.0, 1.0))
    blocks = np.kron(np.eye(2), turn.T)
    turned = replace(
        pose,
        rotation=pose.rotation @ turn,
        position=turn.T @ pose.position,
        covariance=blocks @ pose.covariance @ blocks.T,
    )
    one = geo_pose(pose, HERE, EXACT, CALIBRATION)
    other = geo_pose(turned, HERE, replace(EXACT, rotation=turn), CALIBRATION)
    assert other.latitude == pytest.approx(one.latitude, abs=1e-9)
    assert other.attitude.heading == pytest.approx(one.attitude.heading)
    assert other.radius_95_m == pytest.approx(one.radius_95_m)
    assert other.heading_68_degrees == pytest.approx(one.heading_68_degrees)


def test_errors_that_points_share_and_those_of_the_camera_model_are_in_the_radii() -> None:
    seen = np.array([[40.0, 90.0, 1.0]] * 9)  # 57 units ahead
    pose = replace(pose_at((0.0, 50.0, 1.0), sigma=1e-4), seen_points=seen)
    depth_m = 2 * float((seen[0] - pose.position) @ pose.rotation[2])
    found = geo_pose(pose, HERE, EXACT, CALIBRATION)
    assert found.radius_68_m == pytest.approx(1.067 * 2**0.5 * 0.0025 * depth_m, rel=0.01)
    of_map = geo_pose(replace(pose, camera_source=CameraSource.MAP), HERE, EXACT, CALIBRATION)
    assert of_map.radius_68_m < 0.01 * found.radius_68_m
    floor = CALIBRATION.model_copy(update={"position_floor": 0.5, "heading_floor": 0.02})
    wider = geo_pose(pose, HERE, EXACT, floor)
    assert wider.radius_95_m == pytest.approx(np.hypot(4 * 2 * 0.5, found.radius_95_m), rel=0.01)
    assert wider.heading_68_degrees > found.heading_68_degrees + 1
