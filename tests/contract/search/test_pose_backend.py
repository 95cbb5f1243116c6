"""Poses in a reconstruction, by a worker in process and over HTTP."""

from __future__ import annotations

from typing import Any

import httpx2
import numpy as np
import pytest

from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.geodesy import distance_m
from shared.geometry.cameras import Camera, hash_camera_key
from shared.geometry.component import rotation_matrix
from shared.ids import new_id
from shared.matching.features import LocalFeatures
from shared.search_api.protocol import (
    MAX_SEEN_POINTS,
    ComponentPose,
    PoseCandidate,
    PoseComponent,
    PoseRequest,
    PoseResponse,
    SearchBackend,
)
from shared.storage import FolderStore
from tests.support.local_features import MODEL, put_features, scene_features
from tests.support.poses import (
    ALIGNMENT,
    CALIBRATION,
    CENTRE,
    HEADING,
    ORIGIN,
    SIMILARITY,
    TURN_DEGREES,
    take_query,
)
from tests.support.reconstructed_scene import CAMERA, ReconstructedScene, rays_of
from tests.support.search_tier import SearchTier

pytestmark = pytest.mark.databases("sqlite")
COMPONENT_KEY = "reconstructions/1/0.npz"


@pytest.fixture
def scene() -> ReconstructedScene:
    return ReconstructedScene()


def pose_request(
    store: FolderStore,
    scene: ReconstructedScene,
    query: LocalFeatures | None = None,
    **fields: Any,
) -> PoseRequest:
    """Store the scene, and request the pose of a query whose focal length is known.

    The candidates are a photo of another place, and those of the scene.
    """
    store.put(COMPONENT_KEY, scene.component.encode())
    references = put_features(store, scene_features(1), *scene.features.values())
    values: dict[str, Any] = {
        "query": put_features(store, query or take_query(scene), key="queries/1.features")[0],
        "candidates": tuple(
            PoseCandidate(photo_id=photo_id, **reference.model_dump())
            for photo_id, reference in zip([new_id(), *scene.features], references, strict=True)
        ),
        "features_model": MODEL,
        "components": (
            PoseComponent(object_key=COMPONENT_KEY, alignment=ALIGNMENT, calibration=CALIBRATION),
        ),
        "focal_length": CAMERA.focal_length,
        "camera_source": "exif",
    }
    return PoseRequest(**(values | fields))


def found(response: PoseResponse) -> ComponentPose:
    assert response.pose is not None, response.reason
    return response.pose


def test_pose_is_that_of_the_camera_in_the_component_and_on_the_earth(
    backend: SearchBackend, store: FolderStore, scene: ReconstructedScene
) -> None:
    request = pose_request(store, scene)
    for _ in range(2):  # the second time from memory
        pose = found(backend.estimate_pose(request))
        assert np.linalg.norm(pose.position - CENTRE) < 0.05
        assert (pose.component, pose.camera_source) == (0, "exif")
        assert pose.focal_pixels == pytest.approx(CAMERA.focal_pixels, rel=0.02)
        assert 50 < pose.inliers <= pose.matches
        assert 50 < len(pose.seen) <= min(pose.inliers, MAX_SEEN_POINTS)
        rotation = rotation_matrix(pose.quaternion)
        points = np.array([seen.point for seen in pose.seen])
        shown = CAMERA.project((points - pose.position) @ rotation.T)
        pixels = np.array([seen.query for seen in pose.seen])
        assert np.linalg.norm(shown - pixels, axis=1).max() < 8
        on_earth = pose.geographic
        assert on_earth is not None
        place = ORIGIN.to_geographic(SIMILARITY.apply(CENTRE))
        assert on_earth.altitude_m == pytest.approx(place.altitude_m, abs=0.1)
        assert on_earth.heading == pytest.approx((HEADING - TURN_DEGREES) % 360, abs=0.3)
        assert (on_earth.pitch, on_earth.roll) == pytest.approx((0, 0), abs=0.3)
        assert 0 < on_earth.radius_68_m < on_earth.radius_95_m < 0.5
        away = distance_m(place.latitude, place.longitude, on_earth.latitude, on_earth.longitude)
        assert away < 0.15


def test_unknown_focal_length_is_estimated_or_that_of_the_same_photo_in_the_reconstruction(
    backend: SearchBackend, store: FolderStore, scene: ReconstructedScene
) -> None:
    camera = Camera(640, 480, 420.0)
    unknown = {"focal_length": None, "camera_source": "estimated"}
    request = pose_request(store, scene, take_query(scene, camera), **unknown)
    pose = found(backend.estimate_pose(request))
    assert pose.camera_source == "estimated"
    assert pose.focal_pixels == pytest.approx(camera.focal_pixels, rel=0.1)
    stored = request.candidates[3]
    again = request.model_copy(update={"query": stored, "leave_out": (stored.photo_id,)})
    pose = found(backend.estimate_pose(again))
    assert pose.camera_source == "map"
    assert np.linalg.norm(pose.position - scene.component.centres()[2]) < 0.05


def test_query_by_a_camera_of_the_reconstruction_has_its_refined_focal_length(
    backend: SearchBackend, store: FolderStore, scene: ReconstructedScene
) -> None:
    wrong = 1.3 * CAMERA.focal_length  # in the EXIF of all photos of this camera
    request = pose_request(store, scene, focal_length=wrong)
    same = tuple(one.model_copy(update={"focal_length": wrong}) for one in request.candidates)
    pose = found(backend.estimate_pose(request.model_copy(update={"candidates": same})))
    assert pose.camera_source == "map"
    assert pose.focal_pixels == pytest.approx(CAMERA.focal_pixels, rel=0.02)
    near = 1.05 * CAMERA.focal_length
    same = tuple(one.model_copy(update={"focal_length": near}) for one in request.candidates)
    given = {"candidates": same, "focal_length": near, "camera_source": "given"}
    pose = found(backend.estimate_pose(request.model_copy(update=given)))
    assert pose.camera_source == "given"


@pytest.mark.parametrize(
    ("key", "source", "expected"),
    [("camera 1", "exif", "map"), ("camera 2", "exif", "exif"), ("camera 1", "given", "given")],
)
def test_camera_of_an_imported_model_serves_queries_with_its_key_alone(
    backend: SearchBackend,
    store: FolderStore,
    scene: ReconstructedScene,
    key: str,
    source: str,
    expected: str,
) -> None:
    rays = rays_of(CAMERA, hash_camera_key("camera 1"))
    imported = scene.component.with_rays(dict.fromkeys(scene.features, rays))
    request = pose_request(store, scene, camera_key=key, camera_source=source)
    store.put(COMPONENT_KEY, imported.encode())
    same = {"focal_length": CAMERA.focal_length}
    candidates = tuple(one.model_copy(update=same) for one in request.candidates)
    pose = found(backend.estimate_pose(request.model_copy(update={"candidates": candidates})))
    assert pose.camera_source == expected
    assert np.linalg.norm(pose.position - CENTRE) < 0.05


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("no features", "no local features"),
        ("no texture", "too little texture"),
        ("small", "shorter than 240 pixels"),
        ("other model", "Send the photo again, or make a new reconstruction"),
        ("missing component", "The reconstruction can't be read"),
        ("damaged component", "The reconstruction can't be read"),
        ("other photos", "belongs to the reconstruction"),
        ("only itself", "belongs to the reconstruction"),
        ("other place", "points of the model"),
    ],
)
def test_query_without_a_pose_gets_the_reason(
    backend: SearchBackend, store: FolderStore, scene: ReconstructedScene, case: str, reason: str
) -> None:
    request = pose_request(store, scene)
    candidates = request.candidates
    changes: dict[str, dict[str, Any]] = {
        "no texture": {"query": LocalFeatures.empty((640, 480), 64)},
        "small": {"query": LocalFeatures.empty((8, 8), 64)},
        "other model": {"features_model": "other@0123456789ab"},
        "other photos": {"candidates": candidates[:1]},
        "only itself": {"candidates": candidates[:2], "leave_out": (candidates[1].photo_id,)},
        "other place": {"query": scene_features(1)},
    }
    request = pose_request(store, scene, **changes.get(case, {}))
    if case == "no features":
        store.delete(request.query.object_key)
    elif case == "missing component":
        store.delete(COMPONENT_KEY)
    elif case == "damaged component":
        store.put(COMPONENT_KEY, store.get(COMPONENT_KEY)[:-100])
    response = backend.estimate_pose(request)
    assert response.pose is None
    assert response.reason is not None
    assert reason in response.reason


def test_points_that_determine_no_pose_are_a_reason_and_no_error(
    backend: SearchBackend, store: FolderStore, scene: ReconstructedScene
) -> None:
    scene.component.covariances[:] = -1e9 * np.eye(3)
    response = backend.estimate_pose(pose_request(store, scene))
    assert response.reason == "The points of the model that match determine no position."


def test_readable_components_are_used_when_others_are_lost(
    backend: SearchBackend, store: FolderStore, scene: ReconstructedScene
) -> None:
    request = pose_request(store, scene)
    lost = PoseComponent(object_key="reconstructions/1/1.npz")
    request = request.model_copy(update={"components": (lost, *request.components)})
    pose = found(backend.estimate_pose(request))
    assert pose.component == 1
    assert pose.geographic is not None


def test_next_worker_answers_when_one_is_down_and_the_metrics_count_poses(
    catalog: Catalog, store: FolderStore, settings: Settings, scene: ReconstructedScene
) -> None:
    request = pose_request(store, scene)
    with SearchTier(catalog, store, settings, 2) as tier:
        first, second = tier.servers
        second.stop()
        for _ in range(3):  # the order of the workers is random
            found(tier.port.estimate_pose(request))
        nowhere = request.model_copy(update={"candidates": ()})
        assert tier.port.estimate_pose(nowhere).pose is None
        metrics = httpx2.get(f"{first.url}/metrics").text
        assert 'placewise_search_poses_total{outcome="answered"} 4.0' in metrics
        assert 'placewise_search_pose_answers_total{outcome="found"} 3.0' in metrics
        assert 'placewise_search_pose_answers_total{outcome="no_pose"} 1.0' in metrics
        first.stop()
        with pytest.raises(Unavailable) as caught:
            tier.port.estimate_pose(request)
        assert caught.value.code == "search_unavailable"
