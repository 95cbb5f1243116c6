"""Reconstructions of a scene whose poses are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from services.extractor.geometry.imported_models import import_model, turned_camera
from services.extractor.geometry.mapping import Judged, MappedComponent, count_joined, map_photos
from services.extractor.geometry.matching import VerifiedMatches, match_pairs
from services.extractor.geometry.positions import misplaced_photos
from services.extractor.geometry.pycolmap_models import PhotoToMap, deregister
from shared.errors import Unprocessable
from shared.geometry.cameras import Camera, Rays
from shared.geometry.colmap_model import CAMERA_MODELS
from shared.geometry.component import NO_POINT, Component
from shared.geometry.frames import umeyama
from tests.support.reconstructed_scene import ReconstructedScene

PHOTOS = 8
CAMERA = Camera(1280, 960, 1000.0)


def everything(scene: ReconstructedScene) -> tuple[list[PhotoToMap], VerifiedMatches]:
    photos = [
        PhotoToMap(photo, f.width, f.height, f.pixels().astype(np.float32))
        for photo, f in scene.features.items()
    ]
    pairs = np.array([(i, j) for j in range(len(photos)) for i in range(j)], np.int32)
    return photos, match_pairs(scene.features, pairs, lambda _: None)


def position_errors(found: Component, scene: ReconstructedScene) -> np.ndarray:
    truth = dict(zip(scene.component.photo_ids, scene.component.centres(), strict=True))
    centres = np.array([truth[photo] for photo in found.photo_ids])
    scale, rotation, translation = umeyama(found.centres(), centres, np.ones(len(centres)))
    aligned = scale * found.centres() @ rotation.T + translation
    return np.asarray(np.linalg.norm(aligned - centres, axis=1))


def only(components: list[MappedComponent]) -> MappedComponent:
    (found,) = components
    return found


def map_all(
    photos: list[PhotoToMap], matches: VerifiedMatches, folder: Path, *existing: Path
) -> MappedComponent:
    """Return the only component of the photos."""
    return only(map_photos(photos, matches, folder, lambda _: None, lambda: None, existing))


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return ReconstructedScene(photos=PHOTOS, camera=CAMERA)


@pytest.fixture(scope="module")
def mapped(scene: ReconstructedScene, tmp_path_factory: pytest.TempPathFactory) -> MappedComponent:
    tried: list[int] = []
    found = only(
        map_photos(*everything(scene), tmp_path_factory.mktemp("map"), tried.append, lambda: None)
    )
    assert max(tried) <= PHOTOS
    return found


def test_reconstruction_has_the_poses_and_the_camera_of_the_photos(
    scene: ReconstructedScene, mapped: MappedComponent
) -> None:
    component = mapped.component
    assert set(component.photo_ids) == set(scene.features)
    assert position_errors(component, scene).max() < 0.1
    (camera,) = component.cameras
    assert (camera.width, camera.height) == (1280, 960)
    assert camera.focal_pixels == pytest.approx(1000, rel=0.02)
    assert 0.1 < mapped.mean_reprojection_error_pixels < 0.6  # 0.5 in photos of twice the size
    for photo, numbers in zip(component.photo_ids, component.point_numbers, strict=True):
        assert len(numbers) == len(scene.features[photo].positions)
        assert (numbers != NO_POINT).mean() > 0.5
    counts = np.bincount(np.concatenate([n[n >= 0] for n in component.point_numbers]))
    np.testing.assert_array_equal(counts, component.observations)


def test_points_are_within_their_covariance(
    scene: ReconstructedScene, mapped: MappedComponent
) -> None:
    component = mapped.component
    truth_of = dict(zip(scene.component.photo_ids, scene.component.point_numbers, strict=True))
    truth = np.full(len(component.points), -1)
    for photo, numbers in zip(component.photo_ids, component.point_numbers, strict=True):
        is_seen = (numbers >= 0) & (truth_of[photo] >= 0)
        truth[numbers[is_seen]] = truth_of[photo][is_seen]
    points, true = component.points[truth >= 0], scene.xyz[truth[truth >= 0]]
    scale, rotation, translation = umeyama(points, true, np.ones(len(points)))
    errors = ((true - translation) @ rotation / scale) - points
    covariances = component.covariances[truth >= 0] * 0.25**2  # working pixels of noise
    squares = np.einsum("pi,pij,pj->p", errors, np.linalg.inv(covariances), errors)
    assert 1.0 < np.median(squares) < 5.0  # 2.4 of chi-squared in three dimensions


def test_photo_is_in_one_component_only(
    scene: ReconstructedScene, mapped: MappedComponent, tmp_path: Path
) -> None:
    found = map_all(*everything(scene), tmp_path, mapped.folder, mapped.folder)
    assert set(found.component.photo_ids) == set(scene.features)


def test_photos_are_misplaced_that_contradict_their_best_matches_or_match_one_outside_more(
    scene: ReconstructedScene, mapped: MappedComponent
) -> None:
    photos, matches = everything(scene)
    ids = [str(photo.id) for photo in photos]
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d([0, 0, 0.05, 1]), np.zeros(3))

    def misplaced(
        *turned: int, outside: int = PHOTOS, found: VerifiedMatches = matches
    ) -> set[int]:
        model = pycolmap.Reconstruction(str(mapped.folder))
        deregister(model, set(ids[outside : outside + 1]))
        for image in map(model.image, model.reg_image_ids()):
            if ids.index(image.name) in turned:
                frame = model.frame(image.frame_id)
                frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
        is_used = np.ones(len(found.pairs), dtype=bool)
        names, contradicts = misplaced_photos(model, photos, found, is_used)
        dropped.append(found.pairs[contradicts].tolist())
        return set(map(ids.index, names))

    dropped: list[list[list[int]]] = []
    assert [misplaced(), misplaced(3), misplaced(2, 4)] == [set(), {3}, {2, 4}]
    assert misplaced(1, 3, 5) == set(range(PHOTOS))  # the model is bent
    assert dropped == [[], [], [], [pair for pair in matches.pairs.tolist() if {1, 3, 5} & {*pair}]]
    few = matches.only((matches.pairs[:, 0] > 0) | np.isin(matches.pairs[:, 1], (1, 7)))
    assert [misplaced(outside=1), misplaced(outside=1, found=few)] == [set(), {0}]


def test_colmap_model_has_the_sizes_of_the_photos(mapped: MappedComponent) -> None:
    model = pycolmap.Reconstruction(str(mapped.folder))
    (camera,) = model.cameras.values()
    assert (camera.width, camera.height) == (1280, 960)
    assert (camera.principal_point_x, camera.principal_point_y) == (640, 480)
    assert {i.name for i in model.images.values()} == {str(p) for p in mapped.component.photo_ids}
    assert model.compute_mean_reprojection_error() == pytest.approx(
        2 * mapped.mean_reprojection_error_pixels, rel=0.01
    )


def test_new_photos_are_registered_into_an_existing_model(
    scene: ReconstructedScene, tmp_path: Path
) -> None:
    photos, matches = everything(scene)
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
    old = map_all(photos[:5], matches, tmp_path / "old")
    assert len(old.component.photo_ids) == 5
    new = map_all(photos, matches, tmp_path / "new", old.folder)
    assert set(new.component.photo_ids) == set(scene.features)
    assert position_errors(new.component, scene).max() < 0.1


def test_model_of_another_tool_is_imported_with_its_poses(
    scene: ReconstructedScene, mapped: MappedComponent, tmp_path: Path
) -> None:
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    out.mkdir()
    model = pycolmap.Reconstruction(str(mapped.folder))
    names = {}
    for number, image in sorted(model.images.items()):
        photo = next(p for p in scene.features if str(p) == image.name)
        names[f"walk/{number:03}.jpg"] = photo
        image.name = f"walk/{number:03}.jpg"
    model.delete_all_points2D_and_points3D()  # its keypoints are not ours
    model.write_text(str(source))
    left_out = names.pop("walk/001.jpg")
    photos, matches = everything(scene)
    found = only(import_model(photos, names, matches, out, source, lambda: None)).component
    assert set(found.photo_ids) == set(scene.features) - {left_out}
    rows = [mapped.component.photo_ids.index(photo) for photo in found.photo_ids]
    np.testing.assert_allclose(found.centres(), mapped.component.centres()[rows], atol=1e-6)
    assert len(found.points) > 200
    with pytest.raises(Unprocessable, match="name of a photo"):
        import_model(photos, {}, matches, out, source, lambda: None)
    (source / "images.txt").write_text("1 nonsense\n")
    with pytest.raises(Unprocessable, match="no COLMAP model"):
        import_model(photos, names, matches, out, source, lambda: None)


def test_wrong_focal_length_of_exif_does_not_end_the_reconstruction(
    scene: ReconstructedScene, tmp_path: Path
) -> None:
    photos, matches = everything(scene)
    wrong = [replace(photo, focal_length=1.6) for photo in photos]  # it is 0.78
    found = map_all(wrong, matches, tmp_path).component
    assert len(found.photo_ids) >= PHOTOS - 1
    assert position_errors(found, scene).max() < 0.3
    assert found.cameras[0].focal_pixels == pytest.approx(1000, rel=0.05)


def test_model_has_the_positions_of_its_photos_as_its_frame(
    scene: ReconstructedScene, tmp_path: Path
) -> None:
    photos, matches = everything(scene)
    truth = dict(zip(scene.component.photo_ids, scene.component.centres(), strict=True))
    placed = [replace(photo, position=10 * truth[photo.id] + (300, -200, 5)) for photo in photos]
    found = map_all(placed, matches, tmp_path).component
    expected = np.array([10 * truth[id_] + (300, -200, 5) for id_ in found.photo_ids])
    assert np.abs(found.centres() - expected).max() < 0.3


@pytest.mark.parametrize("is_read_upright", [False, True])
def test_imported_poses_are_turned_as_exif_turns_the_photos(
    scene: ReconstructedScene, mapped: MappedComponent, tmp_path: Path, is_read_upright: bool
) -> None:
    """COLMAP reads photos as they lie; a model of other software may be of upright ones."""
    turns = [0, 1, 2, 3]
    model = pycolmap.Reconstruction(str(mapped.folder))
    model.delete_all_points2D_and_points3D()
    source = pycolmap.Reconstruction()
    photos, matches = everything(scene)
    by_name = {str(photo.id): photo for photo in photos}
    for number, image in sorted(model.images.items()):
        turn = turns[number % 4]
        by_name[image.name] = replace(
            by_name[image.name], quarter_turns=turn, camera=bytes([7] * 32)
        )
        back = 0 if is_read_upright else -turn % 4
        camera = turned_camera(pycolmap, image.camera, back)
        camera.camera_id = number
        source.add_camera_with_trivial_rig(camera)
        angle = np.radians(90 * back)
        roll = pycolmap.Rigid3d(pycolmap.Rotation3d([0, 0, angle]), np.zeros(3))
        lying = pycolmap.Image(name=image.name, camera_id=number, image_id=number)
        source.add_image_with_trivial_frame(lying, roll * image.cam_from_world())
    (tmp_path / "source").mkdir()
    source.write_text(str(tmp_path / "source"))
    names = {str(photo): photo for photo in scene.features}
    (tmp_path / "out").mkdir()
    turned = list(by_name.values())
    found = only(
        import_model(turned, names, matches, tmp_path / "out", tmp_path / "source", lambda: None)
    ).component
    assert set(found.photo_ids) == set(scene.features)
    rows = [mapped.component.photo_ids.index(photo) for photo in found.photo_ids]
    for photo, row in enumerate(rows):
        np.testing.assert_allclose(found.rotation(photo), mapped.component.rotation(row), atol=1e-6)
    assert len(found.points) > 200
    known = found.find_camera(bytes([7] * 32))
    assert known is not None
    assert known.focal_length == pytest.approx(mapped.component.cameras[0].focal_length)


@pytest.mark.parametrize("name", [name for name, _ in CAMERA_MODELS.values()])
def test_rays_of_a_camera_of_any_model_are_those_of_its_turned_photos(name: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, name, 400.0, 640, 480)
    params = np.array(camera.params)
    params[camera.principal_point_idxs()] += (60, -30)
    params[camera.extra_params_idxs()] = np.linspace(0.004, 0.01, len(camera.extra_params_idxs()))
    if name in ("EUCM", "FOV"):
        params[camera.extra_params_idxs()] = (0.6, 1.1) if name == "EUCM" else 0.8
    camera.params = params.tolist()
    rays = Rays.fit(camera.cam_ray_from_img, (640, 480), 400 / 640, bytes(32), 0)
    pixels = np.random.default_rng(0).uniform((60, 60), (580, 420), (50, 2))
    seen = np.array(camera.cam_from_img(pixels))
    np.testing.assert_allclose(rays.undistort(pixels, 640, 480), 400 * seen + (320, 240), atol=0.1)
    turned = turned_camera(pycolmap, camera, 1)  # what was at (x, y) is at (480 - y, x)
    moved = np.column_stack([480 - pixels[:, 1], pixels[:, 0]])
    quarter = np.column_stack([-seen[:, 1], seen[:, 0]])
    np.testing.assert_allclose(np.array(turned.cam_from_img(moved)), quarter, atol=1e-6)
    np.testing.assert_allclose(
        rays.turned(1).undistort(moved, 480, 640), 400 * quarter + (240, 320), atol=0.1
    )


def test_photos_of_different_scenes_are_components_of_their_own(
    scene: ReconstructedScene, tmp_path: Path
) -> None:
    other = ReconstructedScene(photos=4, seed=2, camera=CAMERA)
    both = ReconstructedScene(photos=1)
    both.features = {**scene.features, **other.features}
    found = map_photos(*everything(both), tmp_path, lambda _: None, lambda: None)
    assert [set(c.component.photo_ids) for c in found] == [set(scene.features), set(other.features)]


def test_photos_without_matches_are_refused(tmp_path: Path) -> None:
    photos, _ = everything(ReconstructedScene(photos=3))
    none = VerifiedMatches(tuple(p.id for p in photos), np.empty((0, 2), np.int32), ())
    with pytest.raises(Unprocessable, match="too few matches"):
        map_photos(photos, none, tmp_path, lambda _: None, lambda: None)


def test_one_model_joins_more_photos_than_several_that_overlap_unless_it_misplaces_them() -> None:
    def judged(rows: range, *misplaced: str) -> Judged:
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(
            pycolmap.Camera.create_from_model_name(1, "PINHOLE", 500.0, 640, 480)
        )
        for row in rows:
            image = pycolmap.Image(name=str(row), camera_id=1, image_id=row + 1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        return model, set(misplaced), np.zeros(0, dtype=bool)

    parts = [judged(range(6)), judged(range(5, 10)), judged(range(3))]
    for misplaced, is_better in (((), True), (("6", "7", "8"), False)):
        whole = [judged(range(9), *misplaced)]
        assert (count_joined(whole) > count_joined(parts)) == is_better
