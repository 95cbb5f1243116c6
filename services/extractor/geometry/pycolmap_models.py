"""Photos, cameras and matches as pycolmap has them, and its models as components.

A model is computed at the working size of keypoints, so that thresholds in pixels are the same for
photos of any size, and stored at the photos' sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.matching import VerifiedMatches
from shared.errors import Misconfigured, Unprocessable
from shared.geometry.cameras import UNKNOWN_FOCAL_LENGTH, Camera, Floats, Rays
from shared.geometry.component import NO_POINT, Component, bounded_inverse, projection_jacobian
from shared.matching.features import WORKING_SIDE
from shared.matching.verification import MAX_EPIPOLAR_ERROR_PIXELS

MIN_MODEL_PHOTOS = 3
MIN_MODEL_POINTS = 60
RANDOM_SEED = 1


@dataclass(frozen=True, slots=True, eq=False)
class PhotoToMap:
    """What the reconstruction needs of a photo."""

    id: UUID
    width: int
    height: int
    pixels: NDArray[np.float32]
    """(n, 2) positions of its local features"""
    focal_length: float | None = None
    """as a multiple of the longer side; None if EXIF has none"""
    position: Floats | None = None
    """(3,) metres east, north and up in a plane of all photos; up is NaN without an altitude"""
    trusts_focal_length: bool = True
    """whether the reconstruction begins with `focal_length`"""
    quarter_turns: int | None = 0
    """`PhotoHeader.quarter_turns`; only imports look at it"""
    camera: bytes = bytes(32)
    """`hash_camera_key`, of imported photos; zero bytes if it is not known"""

    @property
    def camera_key(self) -> tuple[int, int, float]:
        """Photos with the same key were taken with one camera."""
        return self.width, self.height, round(self.focal_length or 0, 3)


def require_pycolmap() -> Any:
    """Return pycolmap, which is quiet; Misconfigured (`pose_missing`) without it."""
    try:
        import pycolmap
    except ImportError as error:
        raise Misconfigured(
            "pose_missing",
            "Reconstruction needs the package pycolmap, which is not installed. In the repository: "
            "uv pip install '.[pose]'.",
        ) from error
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    return pycolmap


def image_names(model: Any) -> list[str]:
    return [model.image(number).name for number in model.reg_image_ids()]


def write_database(
    pycolmap: Any,
    photos: Sequence[PhotoToMap],
    matches: VerifiedMatches,
    path: Path,
    models: Sequence[Any],
) -> None:
    """Write cameras, keypoints and verified matches; photos of models keep their numbers."""
    by_name = {str(photo.id): photo for photo in photos}
    image_ids: dict[str, int] = {}
    cameras: dict[int, Any] = {}
    camera_of: dict[str, int] = {}
    of_key: dict[tuple[int, int, float], int] = {}
    for model in models:
        for number in model.reg_image_ids():
            image = model.image(number)
            image_ids[image.name] = number
            cameras[image.camera_id] = image.camera
            camera_of[image.name] = image.camera_id
            of_key.setdefault(by_name[image.name].camera_key, image.camera_id)
    first = max(image_ids.values(), default=0) + 1
    new = [photo for name, photo in by_name.items() if name not in image_ids]
    for number, photo in enumerate(new, first):
        image_ids[str(photo.id)] = number
        if photo.camera_key not in of_key:
            camera_id = max(cameras, default=0) + 1
            of_key[photo.camera_key] = camera_id
            cameras[camera_id] = _working_camera(pycolmap, photo, camera_id)
        camera_of[str(photo.id)] = of_key[photo.camera_key]
    database = pycolmap.Database.open(str(path))
    for camera_id in sorted(cameras):
        database.write_camera(cameras[camera_id], use_camera_id=True)
    for name, number in sorted(image_ids.items(), key=lambda item: item[1]):
        image = pycolmap.Image(name=name, camera_id=camera_of[name], image_id=number)
        database.write_image(image, use_image_id=True)
        database.write_keypoints(number, working_pixels(by_name[name]))
    lines = []
    for (one, other), keypoints in zip(matches.pairs.tolist(), matches.keypoints, strict=True):
        pair = str(matches.photo_ids[one]), str(matches.photo_ids[other])
        if pair[0] in image_ids and pair[1] in image_ids:
            numbers = image_ids[pair[0]], image_ids[pair[1]]
            database.write_matches(*numbers, keypoints.astype(np.uint32))
            lines.append(" ".join(pair))
    database.close()
    pairs = path.with_name("pairs.txt")
    pairs.write_text("\n".join(lines))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = MAX_EPIPOLAR_ERROR_PIXELS * 2
    options.ransac.random_seed = RANDOM_SEED
    pycolmap.verify_matches(str(path), str(pairs), options)


def working_pixels(photo: PhotoToMap) -> NDArray[np.float32]:
    return np.asarray(photo.pixels * (WORKING_SIDE / max(photo.width, photo.height)), np.float32)


def _working_camera(pycolmap: Any, photo: PhotoToMap, camera_id: int) -> Any:
    known = photo.focal_length if photo.trusts_focal_length else None
    focal = (known or UNKNOWN_FOCAL_LENGTH) * max(photo.width, photo.height)
    camera = pycolmap.Camera.create_from_model_name(
        camera_id, "SIMPLE_RADIAL", focal, photo.width, photo.height
    )
    camera.has_prior_focal_length = known is not None
    resize(camera, working_scale(camera))
    return camera


def working_scale(camera: Any) -> float:
    return float(WORKING_SIDE / max(camera.width, camera.height))


def resize(camera: Any, scale: float) -> None:
    """Scale a camera; its sides are rounded, its principal point is not."""
    params = np.array(camera.params)
    focals = len(camera.focal_length_idxs())
    params[: focals + 2] *= scale  # of all models of COLMAP, focal lengths and principal point
    camera.width, camera.height = round(camera.width * scale), round(camera.height * scale)
    camera.params = params


def resized(model: Any, scales: Mapping[int, float]) -> Any:
    """Scale cameras and keypoints of a model in place, by camera, and return it."""
    for number, camera in model.cameras.items():
        resize(camera, scales[number])
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy * scales[image.camera_id]
    model.update_point_3d_errors()
    return model


def write_models(
    photos: Sequence[PhotoToMap],
    models: Sequence[Any],
    folder: Path,
    rays: Mapping[int, Rays] = MappingProxyType({}),
) -> list[float]:
    """Write models at the photos' sizes with their components, the one with most photos first.

    `rays` are those of imported cameras.
    """
    by_name = {str(photo.id): photo for photo in photos}
    errors = []
    for number, model in enumerate(_without_shared_photos(models)):
        errors.append(float(model.compute_mean_reprojection_error()))
        scales = {}
        for image in model.images.values():
            photo = by_name[image.name]
            scales[image.camera_id] = max(photo.width, photo.height) / WORKING_SIDE
        component = component_of(model, by_name, scales)
        if rays:
            names = {image.name: image.camera_id for image in model.images.values()}
            known = {id_: rays[names[str(id_)]] for id_ in component.photo_ids}
            component = component.with_rays(known)
        (folder / f"{number}.npz").write_bytes(component.encode())
        resized(model, scales)
        for image in model.images.values():  # exactly, and not as the rounded sides are scaled
            image.camera.width = by_name[image.name].width
            image.camera.height = by_name[image.name].height
        (folder / str(number)).mkdir()
        model.write(str(folder / str(number)))
    if not errors:
        raise Unprocessable(
            "empty_model",
            "No photos could be reconstructed together: too few matches agree with each other.",
        )
    return errors


def deregister(model: Any, names: AbstractSet[str]) -> None:
    for number in list(model.reg_image_ids()):
        if model.image(number).name in names:
            model.deregister_frame(model.image(number).frame_id)


def _without_shared_photos(models: Sequence[Any]) -> list[Any]:
    """Return the models, most photos first, each photo in that where it shows most points.

    pycolmap lets the models of one run overlap. A photo in two frames would have two poses.
    """
    shown: dict[str, int] = {}
    for model in models:
        for number in model.reg_image_ids():
            image = model.image(number)
            shown[image.name] = max(shown.get(image.name, 0), image.num_points3D)
    disjoint: list[Any] = []
    taken: set[str] = set()
    for model in sorted(models, key=lambda model: -model.num_reg_images()):
        images = [model.image(number) for number in model.reg_image_ids()]
        elsewhere = {each.name for each in images if each.num_points3D < shown[each.name]}
        deregister(model, taken | elsewhere)
        is_enough = model.num_reg_images() >= MIN_MODEL_PHOTOS
        if is_enough and model.num_points3D() >= MIN_MODEL_POINTS:
            disjoint.append(model)
            taken.update(image_names(model))
    return disjoint


def component_of(
    model: Any, photos: Mapping[str, PhotoToMap], scales: Mapping[int, float] = MappingProxyType({})
) -> Component:
    """Return the component of a model at the working size; `scales` of cameras lead to photos'."""
    point_ids = sorted(model.point3D_ids())
    number_of = {point: number for number, point in enumerate(point_ids)}
    xyz = np.array([model.point3D(point).xyz for point in point_ids]).reshape(-1, 3)
    camera_numbers = {number: row for row, number in enumerate(sorted(model.cameras))}
    ids, rotations, translations, numbers_of_photos, cameras = [], [], [], [], []
    counts = np.zeros(len(point_ids), np.int32)
    information = np.zeros((len(point_ids), 3, 3))
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        numbers = np.full(len(image.points2D), NO_POINT, np.int32)
        for row in image.get_observation_point2D_idxs():
            numbers[row] = number_of[image.points2D[row].point3D_id]
        pose = image.cam_from_world()
        ids.append(photos[image.name].id)
        x, y, z, w = pose.rotation.quat
        rotations.append((w, x, y, z))
        translations.append(pose.translation)
        cameras.append(camera_numbers[image.camera_id])
        numbers_of_photos.append(numbers)
        seen = np.unique(numbers[numbers != NO_POINT])
        counts[seen] += 1
        jacobian = projection_jacobian(
            xyz[seen], pose.rotation.matrix(), pose.translation, image.camera.mean_focal_length()
        )
        information[seen] += jacobian.transpose(0, 2, 1) @ jacobian
    return Component(
        tuple(ids),
        np.array(rotations),
        np.array(translations),
        np.array(cameras, np.int32),
        tuple(numbers_of_photos),
        tuple(
            _stored_camera(model.camera(number), scales.get(number, 1.0))
            for number in sorted(model.cameras)
        ),
        xyz,
        bounded_inverse(information).astype(np.float32),
        counts,
    )


def _stored_camera(camera: Any, scale: float) -> Camera:
    """Return a camera at its photos' size; of other models the focal length alone."""
    radial = float(camera.params[3]) if camera.model_name == "SIMPLE_RADIAL" else 0.0
    width, height = round(camera.width * scale), round(camera.height * scale)
    return Camera(width, height, float(camera.mean_focal_length() * scale), radial)
