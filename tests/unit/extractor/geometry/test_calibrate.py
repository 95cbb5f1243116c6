"""Errors of left-out photos, their quantiles, and proposals for wrong coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from uuid import UUID

import numpy as np
import pytest

from services.extractor.geometry.calibrate import (
    ComponentPhotos,
    CoordinateProposal,
    LeftOutPose,
    calibrate,
    localise_left_out,
    propose_coordinates,
)
from shared.geodesy import distance_m
from shared.geometry.component import Component
from shared.geometry.frames import EastNorthUp, Similarity, align, rotation_of_vector
from shared.matching.features import LocalFeatures
from tests.support.reconstructed_scene import CAMERA, ReconstructedScene, rays_of

COUNT = 10
SHRINKS = 0.8
PLANE = EastNorthUp(45.0, 179.99999)


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return ReconstructedScene(photos=COUNT)


def left_out(
    scene: ReconstructedScene,
    seconds: np.ndarray,
    similarity: Similarity | None = None,
    component: Component | None = None,
    features: Mapping[UUID, LocalFeatures] | None = None,
    *,
    knows_lens: bool = False,
) -> list[LeftOutPose | None]:
    reports: list[int] = []
    photos = ComponentPhotos(
        component or scene.component,
        features or scene.features,
        np.eye(COUNT, dtype=np.float32),
        seconds,
        [500 / 640 if n % 2 else None for n in range(COUNT)],
        similarity,
    )
    found = localise_left_out(photos, reports.append, knows_lens=knows_lens)
    assert reports == list(range(1, len(found) + 1))
    return found


def test_photos_are_localised_without_themselves_and_their_neighbours(
    scene: ReconstructedScene,
) -> None:
    poses = left_out(scene, np.full(COUNT, np.nan))
    assert all(pose and pose.distance < 10 * pose.distance_sigma for pose in poses)
    calibration = calibrate(poses)
    assert calibration.poses == COUNT
    assert calibration.share_found == 1
    assert 0.2 < calibration.position_68 < 5
    # Within 2 s of each other, no other photo is left for any of them.
    assert left_out(scene, np.linspace(0, 1.9, COUNT)) == [None] * COUNT


def test_photos_of_an_imported_camera_are_localised_with_its_rays(
    scene: ReconstructedScene,
) -> None:
    shrunk = {
        id_: replace(each, positions=np.round(SHRINKS * each.positions).astype(np.uint16))
        for id_, each in scene.features.items()
    }
    rays = rays_of(CAMERA, bytes([7] * 32), SHRINKS)
    imported = scene.component.with_rays(dict.fromkeys(scene.features, rays))
    for knows_lens in (True, False):
        poses = left_out(
            scene, np.full(COUNT, np.nan), None, imported, shrunk, knows_lens=knows_lens
        )
        assert len(poses) == COUNT
        assert all(pose and pose.distance < 10 * pose.distance_sigma for pose in poses)
        without_rays = left_out(scene, np.full(COUNT, np.nan), knows_lens=knows_lens)
        expected = np.median([pose.distance for pose in without_rays if pose])
        assert np.median([pose.distance for pose in poses if pose]) < 3 * expected


def test_photos_by_other_lenses_are_expected_to_be_less_exact(scene: ReconstructedScene) -> None:
    anywhere = np.full(COUNT, np.nan)
    known = left_out(scene, anywhere, knows_lens=True)
    assert len(known) == COUNT / 2  # the others have no focal length in their EXIF
    for own, other in zip(known, left_out(scene, anywhere)[1::2], strict=True):
        assert own
        assert other
        assert other.distance_sigma > own.distance_sigma
        assert other.distance < 4 * other.distance_sigma


def test_errors_of_an_aligned_component_are_horizontal(scene: ReconstructedScene) -> None:
    turn = rotation_of_vector(np.array([0.0, np.pi / 2, 0.0]))  # the scene's x is down
    aligned = Similarity(3.0, turn, np.zeros(3), np.zeros((7, 7)), np.zeros(3))
    seconds = np.full(COUNT, np.nan)
    everywhere, horizontal = left_out(scene, seconds), left_out(scene, seconds, aligned)
    for whole, part in zip(everywhere, horizontal, strict=True):
        assert whole
        assert part
        assert part.distance < whole.distance
        assert part.distance_sigma < whole.distance_sigma


def errors(*ratios: float) -> list[LeftOutPose | None]:
    """Return poses whose deviation is 1: half of its square is that of all, the floor."""
    half = math.sqrt(0.5)
    return [LeftOutPose(UUID(int=1), ratio, half, 2 * ratio, half) for ratio in ratios]


def test_quantiles_are_those_of_conformal_prediction() -> None:
    found = calibrate([*errors(*np.arange(1.0, 100.0)), None])
    assert (found.position_68, found.position_95) == pytest.approx((68, 95))
    assert (found.heading_68, found.heading_95) == pytest.approx((136, 190))
    assert (found.position_floor, found.heading_floor) == pytest.approx((0.5**0.5, 0.5**0.5))
    assert (found.poses, found.share_found) == (99, 0.99)


def test_radius_contains_its_share_of_new_errors() -> None:
    rng = np.random.default_rng(0)
    inside = [
        np.abs(rng.standard_t(3, 500))
        < calibrate(errors(*np.abs(rng.standard_t(3, 60)))).position_68
        for _ in range(200)
    ]
    assert np.mean(inside) == pytest.approx(0.68, abs=0.02)


def test_few_poses_never_promise_less_than_the_largest_error() -> None:
    found = calibrate(errors(0.5, 4.0))
    assert (found.position_68, found.position_95) == pytest.approx((4.0, 4.0))
    assert calibrate(errors(0.5)).position_95 == 1.96
    nothing = calibrate([None])
    assert (nothing.position_68, nothing.share_found, nothing.poses) == (1.0, 0, 0)


def proposals_of(scene: ReconstructedScene, wrong_m: dict[int, float]) -> list[CoordinateProposal]:
    """Every unit of the scene is 10 m; photos are so many metres too far north."""
    metres = 10 * scene.component.centres()
    for number, far in wrong_m.items():
        metres[number, 1] += far
    places = [PLANE.to_geographic(row) for row in metres]
    latitudes, longitudes, altitudes = np.array(
        [(p.latitude, p.longitude, p.altitude_m) for p in places]
    ).T
    found = align(
        scene.component.centres(),
        [scene.component.rotation(row) for row in range(len(metres))],
        latitudes,
        longitudes,
        altitudes,
        np.full(len(metres), 3.0),
    )
    return propose_coordinates(scene.component, found, latitudes, longitudes)


def test_coordinates_that_disagree_get_a_proposal(scene: ReconstructedScene) -> None:
    (proposal,) = proposals_of(scene, {4: 50.0})
    right = PLANE.to_geographic(10 * scene.component.centres()[4])
    assert proposal.photo_id == str(scene.component.photo_ids[4])
    assert proposal.distance_m == pytest.approx(50, abs=1)
    off = distance_m(
        proposal.proposed_latitude, proposal.proposed_longitude, right.latitude, right.longitude
    )
    assert off < max(0.1, proposal.radius_95_m)


def test_photos_that_are_right_or_off_together_get_no_proposal(scene: ReconstructedScene) -> None:
    assert proposals_of(scene, {4: 2.0}) == []
    walk = ReconstructedScene(photos=24)
    assert proposals_of(walk, dict.fromkeys(range(19, 24), 60.0)) == []
