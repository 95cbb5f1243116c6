"""Reconstructs the photos of a map with pycolmap, in a child process."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.extractor.child_process import run_in_child
from services.extractor.geometry.evidence import agreeing_pairs
from services.extractor.geometry.matching import VerifiedMatches
from services.extractor.geometry.positions import adjust_to_positions, misplaced_photos
from services.extractor.geometry.pycolmap_models import (
    MIN_MODEL_PHOTOS,
    RANDOM_SEED,
    PhotoToMap,
    deregister,
    image_names,
    require_pycolmap,
    resized,
    working_scale,
    write_database,
    write_models,
)
from shared.errors import Unprocessable
from shared.geometry.component import Component
from shared.geometry.localise import PLAUSIBLE_FOCAL_LENGTHS
from shared.matching.features import WORKING_SIDE

MIN_FOCAL_PHOTOS = 10
"""of a component that tells the focal length of its camera"""
MAX_CUTS = 3
"""Times that photos are reconstructed again because the model has some at a wrong place"""
POOR_SHARE = 0.5
"""of the photos in the largest component: with less, the focal lengths of EXIF may be wrong"""
ENOUGH_SHARE = 0.9
"""of the photos in the largest component: a second run would add little"""

Judged = tuple[Any, set[str], NDArray[np.bool_]]
"""A model of pycolmap with its misplaced photos and the matches that led there"""


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
    return in_child(_map, photos, matches, folder, list(existing), on_progress, check)


def in_child(
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
            scales = {number: working_scale(camera) for number, camera in model.cameras.items()}
            models.append(resized(model, scales))
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
        database = Path(scratch) / "first.db"
        write_database(pycolmap, photos, matches.only(is_used), database, models)
        rest = {str(photo.id) for photo in photos}.difference(*map(image_names, models))
        found: list[Any] = []
        for number, model in enumerate(models):
            start = Path(scratch) / f"start-{number}"
            start.mkdir()
            model.write(str(start))
            extended = run(database, start, rest | set(image_names(model)), True)
            found.append(extended[0] if extended else model)
            rest -= set(image_names(found[-1]))
        databases = (Path(scratch) / f"{number}.db" for number in itertools.count())

        judge = partial(misplaced_photos, photos=photos, matches=matches, is_used=is_used)

        def attempt(tried: Sequence[PhotoToMap], is_known: bool, names: set[str]) -> list[Judged]:
            path = next(databases)
            write_database(pycolmap, tried, matches.only(is_used), path, models)
            made = run(path, "", names, is_known)
            for each in made:
                adjust_to_positions(pycolmap, each, photos)
            return [(each, *judge(each)) for each in made]

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
                        deregister(each, misplaced)
                        misplaced, _ = judge(each)
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
        return write_models(photos, found + plausible, folder)


def count_joined(made: Sequence[Judged]) -> int:
    """Return how many pairs of photos are in one model, each in the first that has it in place."""
    taken, found = set[str](), 0
    for model, misplaced, _ in made:
        names = set(image_names(model)) - misplaced - taken
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
    focals = {
        by_name[image.name].camera_key: float(image.camera.mean_focal_length()) / WORKING_SIDE
        for image in map(model.image, model.reg_image_ids())
    }
    return [
        replace(photo, focal_length=focals.get(photo.camera_key, photo.focal_length))
        for photo in photos
    ]


def _bent_focal_length(model: Any) -> float | None:
    """Return a focal length of a model, in longer sides, that hardly a camera has: it is bent."""
    low, high = PLAUSIBLE_FOCAL_LENGTHS
    found = (c.mean_focal_length() / max(c.width, c.height) for c in model.cameras.values())
    return next((float(each) for each in found if not low <= each <= high), None)
