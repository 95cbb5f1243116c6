"""Localising photos of a scene whose poses are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from shared.errors import Unprocessable
from shared.geometry.cameras import Camera, CameraSource
from shared.geometry.component import Component
from shared.geometry.localise import LocalPose, localise
from shared.matching.features import FULL_SIDE, LocalFeatures
from tests.support.reconstructed_scene import CAMERA, ReconstructedScene, looking

CENTRE = np.array([0.7, -0.5, 0.3])
ROTATION = looking(CENTRE, np.array([1.0, 11.0, 0.5]))


def angle_degrees(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(one @ other.T) - 1) / 2, -1, 1))))


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return ReconstructedScene()


def locate(
    query: LocalFeatures,
    scene: ReconstructedScene,
    camera: Camera | None = None,
    component: Component | None = None,
    leave_out: frozenset[UUID] = frozenset(),
) -> LocalPose:
    """Localise a photo, whose camera is given or estimated, among those of the scene."""
    source = CameraSource.GIVEN if camera else CameraSource.ESTIMATED
    components = [component or scene.component]
    return localise(query, scene.candidates, components, camera, source, leave_out)


@pytest.mark.parametrize("focal", [350.0, 500.0, 800.0])
@pytest.mark.parametrize("is_known", [True, False], ids=["focal length given", "estimated"])
def test_photo_is_localised_with_a_third_of_wrong_matches(
    scene: ReconstructedScene, focal: float, is_known: bool
) -> None:
    camera = replace(CAMERA, focal_pixels=focal)
    query, _ = scene.take(ROTATION, CENTRE, camera, wrong=0.3)
    pose = locate(query, scene, camera if is_known else None)
    assert pose.camera_source == (CameraSource.GIVEN if is_known else CameraSource.ESTIMATED)
    assert pose.component == 0
    assert np.linalg.norm(pose.position - CENTRE) < 0.2
    assert angle_degrees(pose.rotation, ROTATION) < 0.5
    assert pose.camera.focal_pixels == pytest.approx(focal, rel=0.02)
    assert len(pose.seen_points) == len(pose.seen_pixels) >= pose.inliers >= 0.5 * pose.matches
    errors = (
        pose.camera.project((pose.seen_points - pose.position) @ pose.rotation.T) - pose.seen_pixels
    )
    assert np.sqrt(np.mean(errors**2)) < 1


def test_photo_of_another_size_is_localised(scene: ReconstructedScene) -> None:
    camera = Camera(1920, 1080, 1300.0, radial=-0.05)
    query, _ = scene.take(ROTATION, CENTRE, camera)
    pose = locate(query, scene)
    assert np.linalg.norm(pose.position - CENTRE) < 0.5


def test_principal_point_and_distortion_of_a_query_are_estimated_with_its_pose(
    scene: ReconstructedScene,
) -> None:
    query, _ = scene.take(ROTATION, CENTRE, replace(CAMERA, radial=-0.04))
    shift = round(0.005 * FULL_SIDE)  # turns a pose that does not know it by 0.4 degrees
    shifted = replace(query, positions=np.clip(np.add(query.positions, (shift, 0)), 0, FULL_SIDE))
    camera = Camera.of_focal_length(query.width, query.height, CAMERA.focal_length)
    pose = locate(shifted, scene, camera)
    assert angle_degrees(pose.rotation, ROTATION) < 0.2
    assert pose.camera.radial == pytest.approx(-0.04, abs=0.02)


def test_covariance_is_that_of_the_errors_of_many_queries(scene: ReconstructedScene) -> None:
    squares = []
    for _ in range(30):
        query, _ = scene.take(ROTATION, CENTRE, wrong=0.3)
        pose = locate(query, scene, CAMERA)
        turn = pose.rotation.T @ ROTATION
        error = np.concatenate([CENTRE - pose.position, [turn[1, 2], turn[2, 0], turn[0, 1]]])
        squares.append(error @ np.linalg.solve(pose.covariance, error))
    # Six degrees of freedom: the mean of 30 has a standard deviation of 0.63.
    assert 3 < np.mean(squares) < 9


def test_photos_that_are_left_out_are_not_used(scene: ReconstructedScene) -> None:
    photo, features = scene.candidates[2]
    everything = frozenset(scene.features)
    with pytest.raises(Unprocessable):  # its own points, which no two others see
        locate(features, scene, CAMERA, leave_out=everything - {photo})
    pose = locate(features, scene, CAMERA, leave_out=frozenset({photo}))
    assert np.linalg.norm(pose.position - scene.component.centres()[2]) < 0.2


def test_photo_of_another_scene_has_no_pose(scene: ReconstructedScene) -> None:
    query, _ = ReconstructedScene(seed=1).take(ROTATION, CENTRE)
    assert reason(query, scene).endswith(".")
    rest = [scene.component], None, CameraSource.ESTIMATED
    with pytest.raises(Unprocessable, match="None of the best photos of the map is in the model"):
        localise(query, [], *rest)


def keep(features: LocalFeatures, chosen: np.ndarray) -> LocalFeatures:
    return replace(
        features,
        positions=features.positions[chosen],
        descriptors=features.descriptors[chosen],
    )


def reason(query: LocalFeatures, scene: ReconstructedScene, **options: Any) -> str:
    with pytest.raises(Unprocessable) as raised:
        locate(query, scene, **options)
    return raised.value.detail


def test_few_points_in_a_corner_or_many_wrong_matches_are_no_pose(
    scene: ReconstructedScene,
) -> None:
    query, _ = scene.take(ROTATION, CENTRE)
    assert "points of the model agree" in reason(keep(query, np.arange(25)), scene)
    dense = ReconstructedScene(points=3000)
    query, _ = dense.take(ROTATION, CENTRE)
    pixels = query.pixels()
    corner = np.flatnonzero((np.abs(pixels - (500, 350)) < 65).all(axis=1))
    assert len(corner) > 30
    assert "small part" in reason(keep(query, corner), dense, camera=CAMERA)
    query, _ = dense.take(ROTATION, CENTRE, wrong=0.85)
    assert "Only" in reason(query, dense, camera=CAMERA)


def test_panorama_is_no_pose_unless_its_camera_is_given(scene: ReconstructedScene) -> None:
    wide = Camera(1280, 640, 700.0)
    query, _ = scene.take(ROTATION, CENTRE, wide)
    assert "panorama" in reason(query, scene)
    locate(query, scene, wide)


def test_place_that_exists_twice_is_no_pose(scene: ReconstructedScene) -> None:
    query, _ = scene.take(ROTATION, CENTRE)
    once = scene.component
    names = {photo: UUID(int=photo.int + 1000) for photo in once.photo_ids}
    shift, count = np.array([0.0, 0.0, 50.0]), len(once.points)
    turned = [once.rotation(row) @ shift for row in range(len(names))]
    twice = replace(
        once,
        photo_ids=(*once.photo_ids, *names.values()),
        rotations=np.tile(once.rotations, (2, 1)),
        translations=np.concatenate([once.translations, once.translations - turned]),
        camera_numbers=np.tile(once.camera_numbers, 2),
        point_numbers=(
            *once.point_numbers,
            *(np.where(n >= 0, n + count, n).astype(np.int32) for n in once.point_numbers),
        ),
        points=np.concatenate([once.points, once.points + shift]),
        covariances=np.tile(once.covariances, (2, 1, 1)),
        observations=np.tile(once.observations, 2),
    )
    candidates = [*scene.candidates, *((names[p], f) for p, f in scene.candidates)]
    with pytest.raises(Unprocessable, match="Two places of the model explain the photo"):
        localise(query, candidates, [twice], CAMERA, CameraSource.GIVEN)
    # The photos of one of the two alone know no other place.
    locate(query, scene, CAMERA, twice)


def test_wrong_focal_length_is_a_reason(scene: ReconstructedScene) -> None:
    query, _ = scene.take(ROTATION, CENTRE)
    for factor in (0.55, 1.8):
        wrong = replace(CAMERA, focal_pixels=factor * CAMERA.focal_pixels)
        assert "focal length (given)" in reason(query, scene, camera=wrong)


def test_focal_length_that_no_camera_has_is_a_reason(scene: ReconstructedScene) -> None:
    query, _ = scene.take(ROTATION, CENTRE, Camera(640, 480, 0.325 * 640))
    assert "hardly a camera has" in reason(query, scene)


def test_position_that_is_open_or_far_from_the_photos_is_no_pose(
    scene: ReconstructedScene,
) -> None:
    dense = ReconstructedScene(points=5000, noise_pixels=2.5)
    query, numbers = dense.take(looking(CENTRE, CENTRE + np.array([0.0, 1.0, 0.0])), CENTRE)
    is_wall = np.abs(dense.xyz[numbers, 1] - 11) < 0.3
    is_middle = np.linalg.norm(query.pixels() - (320, 240), axis=1) < 100
    wall = np.flatnonzero(is_wall & is_middle)
    # Of a wall in front, a focal length is as good as another one from farther away.
    assert "leave the position of the camera open" in reason(keep(query, wall), dense)
    query, _ = scene.take(ROTATION, CENTRE)
    elsewhere = replace(scene.component, translations=scene.component.translations + 200.0)
    assert "far away from the photos" in reason(query, scene, component=elsewhere)


def test_features_of_another_detection_are_ignored(scene: ReconstructedScene) -> None:
    query, _ = scene.take(ROTATION, CENTRE)
    fewer = [(p, keep(f, np.arange(len(f.positions) - 1))) for p, f in scene.candidates]
    source = CameraSource.GIVEN
    with pytest.raises(Unprocessable):
        localise(query, fewer, [scene.component], CAMERA, source)
