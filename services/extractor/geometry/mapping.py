"""Reconstructs the photos of a map with pycolmap, in a child process.

The model is computed at the working size of keypoints, so that thresholds in pixels are the same
for photos of any size, and stored at the photos' sizes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.extractor.child_process import run_in_child
from services.extractor.geometry.evidence import agreeing_pairs
from services.extractor.geometry.matching import VerifiedMatches
from services.extractor.geometry.positions import adjust_to_positions, misplaced_photos
from shared.errors import Misconfigured, Unprocessable
from shared.geometry.cameras import UNKNOWN_FOCAL_LENGTH, Camera, Floats, Rays
from shared.geometry.component import (
    NO_POINT,
    Component,
    bounded_inverse,
    projection_jacobian,
)
from shared.geometry.localise import PLAUSIBLE_FOCAL_LENGTHS
from shared.matching.features import WORKING_SIDE
from shared.matching.verification import MAX_EPIPOLAR_ERROR_PIXELS

MIN_MODEL_PHOTOS = 3
MIN_MODEL_POINTS = 60
MIN_FOCAL_PHOTOS = 10
"""of a component that tells the focal length of its camera"""
MAX_CUTS = 3
"""Times that photos are reconstructed again because the model has some at a wrong place"""
POOR_SHARE = 0.5
"""of the photos in the largest component: with less, the focal lengths of EXIF may be wrong"""
ENOUGH_SHARE = 0.9
"""of the photos in the largest component: a second run would add little"""
RANDOM_SEED = 1
DISTORTION_VECTORS = (("p2", "p1"), ("sx1", "sy1"), ("p0", "p1"), ("s0", "s2"), ("s1", "s3"))
"""Parameters of camera models that are the x and y of a vector in the plane of the photo"""


Judged = tuple[Any, set[str], NDArray[np.bool_]]
"""A model of pycolmap with its misplaced photos and the matches that led there"""


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


@dataclass(frozen=True, slots=True, eq=False)
class MappedComponent:
    """A component, and the folder with its COLMAP model, whose image names are photo ids."""

    component: Component
    mean_reprojection_error_pixels: float
    """at the working size"""
    folder: Path


def map_photos(
    photos: Sequence[PhotoToMap],
    matches: VerifiedMatches,
    folder: Path,
    on_progress: Callable[[int], None],
    check: Callable[[], None],
    existing: Sequence[Path] = (),
) -> list[MappedComponent]:
    """Reconstruct photos as far as their matches connect them, the largest component first.

    Args:
        photos: All photos of `matches`, in any order.
        folder: Empty; gets a folder with the COLMAP model of each component: `0`, `1`, ...
        on_progress: Called with the number of photos that were tried.
        check: See `run_in_child`.
        existing: Folders of COLMAP models of some of the photos, as this function writes them: the
            other photos are registered into these first.

    Raises:
        Unprocessable: `empty_model` if no photos can be reconstructed together.
        Misconfigured: `pose_missing` without the extra `pose`.
        ChildKilled: See `run_in_child`.
    """
    require_pycolmap()
    return _in_child(_map, photos, matches, folder, list(existing), on_progress, check)


def import_model(
    photos: Sequence[PhotoToMap],
    names: Mapping[str, UUID],
    matches: VerifiedMatches,
    folder: Path,
    model: Path,
    check: Callable[[], None],
) -> list[MappedComponent]:
    """Serve an existing COLMAP or hloc model: triangulate our keypoints from its camera poses.

    COLMAP reads photos as they lie, and Placewise upright: poses and cameras are turned by the
    photos' EXIF, unless more matches agree with poses of upright photos. Images whose camera has
    another shape than the photo are left out.

    Args:
        photos: The photos of the model.
        names: The photo of each image name of the model; other images are left out.
        folder: See `map_photos`.
        model: Folder with cameras, images and points3D, as `.bin` or `.txt`.

    Raises:
        Unprocessable: `unreadable_model` if pycolmap can't read it, `empty_model` if no image of it
            is one of the photos, or no matches agree with its poses.
        Misconfigured, ChildKilled: See `map_photos`.
    """
    require_pycolmap()
    return _in_child(
        _triangulate, photos, matches, folder, (model, dict(names)), lambda _: None, check
    )


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


def _in_child(
    function: Callable[..., list[float]],
    photos: Sequence[PhotoToMap],
    matches: VerifiedMatches,
    folder: Path,
    models: Any,
    on_progress: Callable[[int], None],
    check: Callable[[], None],
) -> list[MappedComponent]:
    errors = run_in_child(
        function, list(photos), matches, folder, models, on_progress=on_progress, check=check
    )
    return [
        MappedComponent(
            Component.decode((folder / f"{number}.npz").read_bytes()), error, folder / str(number)
        )
        for number, error in enumerate(errors)
    ]


def _map(
    photos: list[PhotoToMap],
    matches: VerifiedMatches,
    folder: Path,
    existing: list[Path],
    report: Callable[[int], None],
) -> list[float]:
    """Write all components into the folder and return their errors; runs in the child."""
    pycolmap = require_pycolmap()
    with TemporaryDirectory(prefix="placewise-map-") as scratch:
        models = []
        for path in existing:
            model = pycolmap.Reconstruction(str(path))
            scales = {number: _working_scale(camera) for number, camera in model.cameras.items()}
            models.append(_resized(model, scales))
        tried = 0

        def count() -> None:
            nonlocal tried
            tried += 1
            report(tried)

        def run(database: Path, start: Path | str, names: set[str], is_known: bool) -> list[Any]:
            options = _pipeline_options(pycolmap, is_known)
            options.image_names = sorted(names)
            with TemporaryDirectory(dir=scratch) as out:
                found = pycolmap.incremental_mapping(
                    str(database), out, out, options, str(start), next_image_callback=count
                )
            return sorted(found.values(), key=lambda model: -model.num_reg_images())

        is_used = agreeing_pairs(photos, matches)
        by_name = {str(photo.id): photo for photo in photos}
        database = Path(scratch) / "first.db"
        _write_database(pycolmap, photos, matches.only(is_used), database, models)
        rest = {str(photo.id) for photo in photos} - {name for m in models for name in _names(m)}
        found: list[Any] = []
        for number, model in enumerate(models):
            start = Path(scratch) / f"start-{number}"
            start.mkdir()
            model.write(str(start))
            extended = run(database, start, rest | set(_names(model)), True)
            found.append(extended[0] if extended else model)
            rest -= set(_names(found[-1]))
        databases = (Path(scratch) / f"{number}.db" for number in itertools.count())

        judge = partial(misplaced_photos, photos=photos, matches=matches, is_used=is_used)

        def attempt(tried: Sequence[PhotoToMap], is_known: bool, names: set[str]) -> list[Judged]:
            path = next(databases)
            _write_database(pycolmap, tried, matches.only(is_used), path, models)
            made = run(path, "", names, is_known)
            for each in made:
                adjust_to_positions(pycolmap, each, photos)
            return [(each, *judge(_component_of(each, by_name))) for each in made]

        anew: list[Judged] = []
        for cuts in range(MAX_CUTS + 1):
            if len(rest) < MIN_MODEL_PHOTOS:
                break
            anew = attempt(photos, bool(models), rest)
            if _largest(anew) < POOR_SHARE * len(rest) and any(p.focal_length for p in photos):
                # A wrong focal length in EXIF leaves no pair to begin with.
                blind = [replace(photo, trusts_focal_length=False) for photo in photos]
                for is_known in (False, True):
                    anew = max(anew, attempt(blind, is_known, rest), key=count_joined)
            if not models and MIN_FOCAL_PHOTOS <= _largest(anew) < ENOUGH_SHARE * len(rest):
                # Small components can't tell their focal length: they get that of the largest one.
                again = attempt(_with_cameras_of(anew[0][0], photos), True, rest)
                anew = max(anew, again, key=count_joined)
            wrong = np.any([contradicts for *_, contradicts in anew], axis=0)
            if cuts == MAX_CUTS or not wrong.any():
                for each, misplaced, _ in anew:
                    while misplaced:  # without these, others may have nothing that holds them
                        _deregister(each, misplaced)
                        misplaced, _ = judge(_component_of(each, by_name))
                break
            is_used &= ~wrong
        plausible = [each for each, *_ in anew if _bent_focal_length(each) is None]
        if anew and not found and not plausible:
            raise Unprocessable(
                "empty_model",
                "No photos could be reconstructed together: their matches agree with a focal "
                f"length of {_bent_focal_length(anew[0][0]):.2f} longer sides only, which hardly a "
                "camera has. Send photos as the camera took them, neither cropped nor with a "
                "changed perspective.",
            )
        return _write_models(photos, found + plausible, folder)


def count_joined(made: Sequence[Judged]) -> int:
    """Return how many pairs of photos are in one model, each in the first that has it in place."""
    taken, found = set[str](), 0
    for model, misplaced, _ in made:
        names = set(_names(model)) - misplaced - taken
        taken |= names
        found += len(names) ** 2
    return found


def _largest(made: Sequence[Judged]) -> int:
    return max((model.num_reg_images() for model, *_ in made), default=0)


def _pipeline_options(pycolmap: Any, is_focal_length_known: bool) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = MIN_MODEL_PHOTOS
    options.extract_colors = False
    options.random_seed = RANDOM_SEED
    # It needs half of the time of walks through corridors, and registers hardly a photo.
    options.structure_less_registration_fallback = False
    if is_focal_length_known:
        # Fewer parameters need fewer matches than COLMAP's defaults, which are made for SIFT.
        options.ba_refine_focal_length = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.init_min_num_inliers = 60
        options.mapper.init_min_tri_angle = 8
        options.mapper.abs_pose_min_num_inliers = 20
    return options


def _with_cameras_of(model: Any, photos: Sequence[PhotoToMap]) -> list[PhotoToMap]:
    """Return the photos with the focal lengths of a model's cameras."""
    by_name = {str(photo.id): photo for photo in photos}
    focals = {}
    for number in model.reg_image_ids():
        image = model.image(number)
        key = by_name[image.name].camera_key
        focals[key] = float(image.camera.mean_focal_length()) / WORKING_SIDE
    return [
        replace(photo, focal_length=focals.get(photo.camera_key, photo.focal_length))
        for photo in photos
    ]


def _triangulate(
    photos: list[PhotoToMap],
    matches: VerifiedMatches,
    folder: Path,
    source: tuple[Path, dict[str, UUID]],
    _report: Callable[[int], None],
) -> list[float]:
    """Write the imported component into the folder and return its error; runs in the child."""
    pycolmap = require_pycolmap()
    path, names = source
    try:
        imported = pycolmap.Reconstruction(str(path))
    except Exception as error:  # pycolmap raises what its file readers raise
        raise Unprocessable(
            "unreadable_model", f"{path.name} is no COLMAP model: {error}"
        ) from error
    by_name = {name: photo for photo in photos for name, id_ in names.items() if id_ == photo.id}
    models = [_turned_model(pycolmap, imported, by_name)]
    if any(photo.quarter_turns != 0 for photo in photos):
        upright = {name: replace(photo, quarter_turns=0) for name, photo in by_name.items()}
        models.append(_turned_model(pycolmap, imported, upright))
    models = [(model, rays) for model, rays in models if model.num_reg_images()]
    if not models:
        raise Unprocessable(
            "empty_model",
            "No image of the model has the name of a photo of the map, and its shape.",
        )
    found = []
    for model, rays in models:
        with TemporaryDirectory(prefix="placewise-map-") as scratch:
            database = Path(scratch) / "database.db"
            _write_database(pycolmap, photos, matches, database, [model])
            made = pycolmap.triangulate_points(model, str(database), scratch, scratch)
            found.append((made, rays))
    best, rays = max(found, key=lambda each: each[0].compute_num_observations())
    return _write_models(photos, [best], folder, rays)


def _turned_model(
    pycolmap: Any, imported: Any, photos: Mapping[str, PhotoToMap]
) -> tuple[Any, dict[int, Rays]]:
    """Return the poses of photos after their turns, without points, and the rays by camera."""
    model = pycolmap.Reconstruction()
    camera_ids: dict[tuple[int, int, bytes], int] = {}
    rays = {}
    for number in sorted(imported.reg_image_ids()):
        image = imported.image(number)
        photo = photos.get(image.name)
        if photo is None or photo.quarter_turns is None:
            continue
        key = image.camera_id, photo.quarter_turns, photo.camera
        camera = turned_camera(pycolmap, image.camera, photo.quarter_turns)
        if not _has_shape(photo, camera):
            continue
        if key not in camera_ids:
            camera.camera_id = camera_ids[key] = len(camera_ids) + 1
            rays[camera.camera_id] = Rays.fit(
                camera.cam_ray_from_img,
                (camera.width, camera.height),
                camera.mean_focal_length() / max(camera.width, camera.height),
                photo.camera,
                photo.quarter_turns,
            )
            _resize(camera, _working_scale(camera))
            model.add_camera_with_trivial_rig(camera)
        ours = pycolmap.Image(
            name=str(photo.id),
            keypoints=_working_pixels(photo).astype(float),
            camera_id=camera_ids[key],
            image_id=number,
        )
        turn = np.eye(3)
        turn[:2, :2] = _turn(photo.quarter_turns)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3)) * image.cam_from_world()
        model.add_image_with_trivial_frame(ours, pose)
    return model, rays


def _turn(quarter_turns: int) -> NDArray[np.float64]:
    """Return the (2, 2) matrix that turns x right, y down clockwise."""
    found = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarter_turns)
    return np.asarray(found)


def turned_camera(pycolmap: Any, camera: Any, quarter_turns: int) -> Any:
    """Return a copy of a camera of any model of COLMAP for photos that are turned clockwise."""
    turned = pycolmap.Camera(camera.todict())
    names = camera.params_info.split(", ")
    values = dict(zip(names, np.array(camera.params).tolist(), strict=True))
    middle = np.array([camera.width, camera.height]) / 2
    if quarter_turns % 2:
        turned.width, turned.height = camera.height, camera.width
        values |= {"fx": values.get("fy", 0), "fy": values.get("fx", 0)}
    centre = _turn(quarter_turns) @ (np.array([values["cx"], values["cy"]]) - middle)
    centre += np.array([turned.width, turned.height]) / 2
    values |= {"cx": centre[0], "cy": centre[1]}
    for x, y in DISTORTION_VECTORS:
        if x in values and y in values:
            values[x], values[y] = _turn(quarter_turns) @ [values[x], values[y]]
    turned.params = [values[name] for name in names]
    return turned


def _has_shape(photo: PhotoToMap, camera: Any) -> bool:
    return bool(abs(camera.width / camera.height * photo.height / photo.width - 1) < 0.01)


def _names(model: Any) -> list[str]:
    return [model.image(number).name for number in model.reg_image_ids()]


def _write_database(
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
        database.write_keypoints(number, _working_pixels(by_name[name]))
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


def _working_pixels(photo: PhotoToMap) -> NDArray[np.float32]:
    return np.asarray(photo.pixels * (WORKING_SIDE / max(photo.width, photo.height)), np.float32)


def _working_camera(pycolmap: Any, photo: PhotoToMap, camera_id: int) -> Any:
    known = photo.focal_length if photo.trusts_focal_length else None
    focal = (known or UNKNOWN_FOCAL_LENGTH) * max(photo.width, photo.height)
    camera = pycolmap.Camera.create_from_model_name(
        camera_id, "SIMPLE_RADIAL", focal, photo.width, photo.height
    )
    camera.has_prior_focal_length = known is not None
    _resize(camera, _working_scale(camera))
    return camera


def _working_scale(camera: Any) -> float:
    return float(WORKING_SIDE / max(camera.width, camera.height))


def _resize(camera: Any, scale: float) -> None:
    """Scale a camera; its sides are rounded, its principal point is not."""
    params = np.array(camera.params)
    focals = len(camera.focal_length_idxs())
    params[: focals + 2] *= scale  # of all models of COLMAP, focal lengths and principal point
    camera.width, camera.height = round(camera.width * scale), round(camera.height * scale)
    camera.params = params


def _resized(model: Any, scales: Mapping[int, float]) -> Any:
    """Scale cameras and keypoints of a model in place, by camera, and return it."""
    for number, camera in model.cameras.items():
        _resize(camera, scales[number])
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy * scales[image.camera_id]
    model.update_point_3d_errors()
    return model


def _write_models(
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
        component = _component_of(model, by_name, scales)
        if rays:
            names = {image.name: image.camera_id for image in model.images.values()}
            known = {id_: rays[names[str(id_)]] for id_ in component.photo_ids}
            component = component.with_rays(known)
        (folder / f"{number}.npz").write_bytes(component.encode())
        _resized(model, scales)
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


def _bent_focal_length(model: Any) -> float | None:
    """Return a focal length of a model, in longer sides, that hardly a camera has: it is bent."""
    low, high = PLAUSIBLE_FOCAL_LENGTHS
    found = (c.mean_focal_length() / max(c.width, c.height) for c in model.cameras.values())
    return next((float(each) for each in found if not low <= each <= high), None)


def _deregister(model: Any, names: AbstractSet[str]) -> None:
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
        _deregister(model, taken | elsewhere)
        is_enough = model.num_reg_images() >= MIN_MODEL_PHOTOS
        if is_enough and model.num_points3D() >= MIN_MODEL_POINTS:
            disjoint.append(model)
            taken.update(_names(model))
    return disjoint


def _component_of(
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
