"""`placewise bench pose`: what it maps, judges and counts."""

from __future__ import annotations

import numpy as np
import pytest

from lab.benchmarks.pose import MappedPhotos, _align, _judge, measure_synthetic
from lab.benchmarks.report import Report
from lab.city.round_trip import STEP_M, plan_round_trip
from lab.city.sessions import NIGHT, SPRING
from shared.geometry.localise import LocalPose
from tests.support.reconstructed_scene import ReconstructedScene

PHOTOS = 8


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return ReconstructedScene(photos=PHOTOS)


def test_photos_of_a_scene_are_mapped_aligned_and_judged(scene: ReconstructedScene) -> None:
    features = list(scene.features.values())
    mapped = MappedPhotos(features, np.linspace(0.0, 60.0, PHOTOS))
    (component,) = mapped.components
    assert len(component.photo_ids) == PHOTOS
    truth = 10 * scene.component.centres() + (0.0, 0.0, 3.0)  # metres
    alignment = _align(mapped, truth)
    calibration = mapped.calibrate(0, alignment)
    assert calibration.poses == PHOTOS
    for number in range(PHOTOS):
        pose = mapped.localise(features[number])
        assert isinstance(pose, LocalPose)
        error, radius_68_m, radius_95_m, *_ = _judge(
            pose, alignment, calibration, truth[number], 0.0
        )
        assert error < 3
        assert 0 < radius_68_m < radius_95_m
    assert len(mapped.pose_seconds) == PHOTOS


def test_poses_of_synthetic_scenes_are_within_their_covariance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lab.benchmarks.pose.SYNTHETIC_POSES", 60)
    report = Report("poses")
    measure_synthetic(report)
    measured = {figure.what: figure.measured for figure in report.figures}
    assert measured["synthetic scenes: within 3 deviations"] > 93
    assert 50 < measured["synthetic scenes: within 68 %, not too many"] < 86


def test_round_trip_closes_and_its_queries_are_on_the_same_streets() -> None:
    plan = plan_round_trip(1, [(SPRING, 4), (NIGHT, 2)], outside=3)
    drive = [photo.camera for photo in plan.photos if photo.role == "database"]
    positions = np.array([camera.position for camera in drive])
    steps = np.linalg.norm(np.diff(positions, axis=0, append=positions[:1]), axis=1)
    assert len(drive) > 100
    assert np.median(steps) == pytest.approx(STEP_M, abs=0.5)
    assert steps.max() < 3 * STEP_M
    asked = [photo for photo in plan.photos if photo.role == "query"]
    assert [photo.session.name for photo in asked] == ["spring"] * 4 + ["night"] * 2 + [
        "spring"
    ] * 3
    distances = [
        np.linalg.norm((positions - photo.camera.position)[:, :2], axis=1).min() for photo in asked
    ]
    assert max(distances[:6]) < 4
    assert min(distances[6:]) > 200
