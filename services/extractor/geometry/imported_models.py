"""Serves models that COLMAP or hloc made: our keypoints are triangulated from their poses."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.mapping import MappedComponent, in_child
from services.extractor.geometry.matching import VerifiedMatches
from services.extractor.geometry.pycolmap_models import (
    PhotoToMap,
    require_pycolmap,
    resize,
    working_pixels,
    working_scale,
    write_database,
    write_models,
)
from shared.errors import Unprocessable
from shared.geometry.cameras import Rays

DISTORTION_VECTORS = (("p2", "p1"), ("sx1", "sy1"), ("p0", "p1"), ("s0", "s2"), ("s1", "s3"))
"""Parameters of camera models that are the x and y of a vector in the plane of the photo"""


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
    return in_child(
        _triangulate, photos, matches, folder, (model, dict(names)), lambda _: None, check
    )


def match_names(names: Sequence[str], paths: Mapping[UUID, str]) -> dict[str, UUID]:
    """Return the photos of the image names of a model, as far as exactly one has each name.

    A name is that of a photo if one of both paths ends with the other: `day 1/a.jpg` is `a.jpg` and
    `walk/day 1/a.jpg`. Of several such photos it is the one with the same path.

    Args:
        names: Of the images.
        paths: Relative path, or else file name, by photo.
    """
    by_file_name = defaultdict[str, list[UUID]](list)
    for id_, path in paths.items():
        by_file_name[path.rpartition("/")[2]].append(id_)
    found: dict[str, UUID] = {}
    for name in names:
        parts = _path_parts(name)
        fitting = []
        for id_ in by_file_name[parts[0]]:
            others = _path_parts(paths[id_])
            common = min(len(parts), len(others))
            if parts[:common] == others[:common]:
                fitting.append(id_)
        same = [id_ for id_ in fitting if _path_parts(paths[id_]) == parts]
        if len(fitting) == 1 or len(same) == 1:
            found[name] = (same or fitting)[0]
    times = Counter(found.values())
    return {name: id_ for name, id_ in found.items() if times[id_] == 1}


def _path_parts(path: str) -> list[str]:
    """Return the parts of a path from its end."""
    return path.replace("\\", "/").split("/")[::-1]


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
            write_database(pycolmap, photos, matches, database, [model])
            made = pycolmap.triangulate_points(model, str(database), scratch, scratch)
            found.append((made, rays))
    best, rays = max(found, key=lambda each: each[0].compute_num_observations())
    return write_models(photos, [best], folder, rays)


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
        shape = camera.width / camera.height * photo.height / photo.width
        if abs(shape - 1) >= 0.01:
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
            resize(camera, working_scale(camera))
            model.add_camera_with_trivial_rig(camera)
        ours = pycolmap.Image(
            name=str(photo.id),
            keypoints=working_pixels(photo).astype(float),
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
