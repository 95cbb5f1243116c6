"""Localising photos of a scene whose poses are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shared.geometry.cameras import Camera, CameraSource
from shared.geometry.localise import LocalPose, NoPose, localise
from shared.matching.matchers import MutualNearest
from tests.support.reconstructed_scene import CAMERA, ReconstructedScene, looking

MATCHER = MutualNearest(0.9)
CENTRE = np.array([0.7, -0.5, 0.3])
ROTATION = looking(CENTRE, np.array([1.0, 11.0, 0.5]))


def angle_degrees(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(one @ other.T) - 1) / 2, -1, 1))))


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return ReconstructedScene()


def found(outcome: LocalPose | NoPose) -> LocalPose:
    assert isinstance(outcome, LocalPose), outcome
    return outcome


@pytest.mark.parametrize("focal", [350.0, 500.0, 800.0])
@pytest.mark.parametrize("is_known", [True, False], ids=["focal length given", "estimated"])
def test_photo_is_localised_with_a_third_of_wrong_matches(
    scene: ReconstructedScene, focal: float, is_known: bool
) -> None:
    camera = replace(CAMERA, focal_pixels=focal)
    query, _ = scene.take(ROTATION, CENTRE, camera, wrong=0.3)
    source = CameraSource.GIVEN if is_known else CameraSource.ESTIMATED
    pose = found(
        localise(
            query,
            scene.candidates,
            [scene.component],
            camera if is_known else None,
            source,
            MATCHER,
        )
    )
    assert pose.camera_source == source
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
    pose = found(
        localise(query, scene.candidates, [scene.component], None, CameraSource.ESTIMATED, MATCHER)
    )
    assert np.linalg.norm(pose.position - CENTRE) < 0.5


def test_covariance_is_that_of_the_errors_of_many_queries(scene: ReconstructedScene) -> None:
    squares = []
    for _ in range(60):
        query, _ = scene.take(ROTATION, CENTRE, wrong=0.3)
        pose = found(
            localise(
                query, scene.candidates, [scene.component], CAMERA, CameraSource.GIVEN, MATCHER
            )
        )
        turn = pose.rotation.T @ ROTATION
        error = np.concatenate([CENTRE - pose.position, [turn[1, 2], turn[2, 0], turn[0, 1]]])
        squares.append(error @ np.linalg.solve(pose.covariance, error))
    # Six degrees of freedom: the mean of 60 has a standard deviation of 0.45.
    assert 3 < np.mean(squares) < 9


def test_photos_that_are_left_out_are_not_used(scene: ReconstructedScene) -> None:
    photo, features = scene.candidates[2]
    everything = frozenset(scene.features)
    outcome = localise(
        features,
        scene.candidates,
        [scene.component],
        CAMERA,
        CameraSource.GIVEN,
        MATCHER,
        everything - {photo},
    )
    assert isinstance(outcome, NoPose)  # its own points, which no two others see
    pose = found(
        localise(
            features,
            scene.candidates,
            [scene.component],
            CAMERA,
            CameraSource.GIVEN,
            MATCHER,
            frozenset({photo}),
        )
    )
    assert np.linalg.norm(pose.position - scene.component.centres()[2]) < 0.2


def test_photo_of_another_scene_has_no_pose(scene: ReconstructedScene) -> None:
    query, _ = ReconstructedScene(seed=1).take(ROTATION, CENTRE)
    outcome = localise(
        query, scene.candidates, [scene.component], None, CameraSource.ESTIMATED, MATCHER
    )
    assert isinstance(outcome, NoPose)
    assert outcome.reason.endswith(".")
    outcome = localise(query, [], [scene.component], None, CameraSource.ESTIMATED, MATCHER)
    assert outcome == NoPose("None of the best photos of the map is in the model.")
