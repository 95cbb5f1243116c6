"""Models of pycolmap beside the positions of their photos: priors, and photos at a wrong place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.evidence import (
    MIN_BLOCK,
    RAYLEIGH_MEDIAN,
    find_misplaced,
    fit_to_positions,
    with_heights,
)
from services.extractor.geometry.matching import VerifiedMatches
from shared.geometry.cameras import Floats
from shared.geometry.frames import UNKNOWN_ALTITUDE_SIGMA_M

if TYPE_CHECKING:
    from services.extractor.geometry.mapping import PhotoToMap

MIN_PRIOR_SIGMA_M = 0.1
"""Least standard deviation of coordinates"""


def _placed(model: Any, photos: Sequence[PhotoToMap]) -> tuple[list[Any], Floats, list[Floats]]:
    """Return a model's images, their centres (n, 3) and positions, NaN where these are unknown."""
    of_name = {str(photo.id): photo.position for photo in photos}
    images = [model.image(number) for number in sorted(model.reg_image_ids())]
    places = [of_name[image.name] for image in images]
    positions = np.array([np.full(3, np.nan) if place is None else place for place in places])
    return images, positions, [image.cam_from_world().rotation.matrix() for image in images]


def misplaced_photos(
    model: Any, photos: Sequence[PhotoToMap], matches: VerifiedMatches
) -> tuple[set[str], NDArray[np.bool_]]:
    """Return the names of a model's misplaced photos, and the (m,) matches that led there."""
    images, positions, rotations = _placed(model, photos)
    rows = {UUID(image.name): row for row, image in enumerate(images)}
    numbers = np.array([rows.get(id_, -1) for id_ in matches.photo_ids], np.int32)[matches.pairs]
    inside = np.flatnonzero((numbers >= 0).all(axis=1))
    counts = np.array([len(k) for k in matches.keypoints], int)
    misplaced, wrong = find_misplaced(
        np.array([image.projection_center() for image in images]),
        rotations,
        positions,
        numbers[inside],
        counts[inside],
    )
    contradicts = np.zeros(len(matches.pairs), dtype=bool)
    contradicts[inside[wrong]] = True
    return {images[row].name for row in np.flatnonzero(misplaced)}, contradicts


def adjust_to_positions(pycolmap: Any, model: Any, photos: Sequence[PhotoToMap]) -> None:
    """Move a model to the positions of its photos, and adjust it with these as priors.

    Their standard deviation is that of the model's distances from them.
    """
    images, positions, rotations = _placed(model, photos)
    known = np.flatnonzero(np.isfinite(positions[:, :2]).all(axis=1))
    if len(known) < MIN_BLOCK:
        return
    centres = np.array([image.projection_center() for image in images])[known]
    found = fit_to_positions(centres, [rotations[row] for row in known.tolist()], positions[known])
    if found is None:
        return
    model.transform(
        pycolmap.Sim3d(found.scale, pycolmap.Rotation3d(found.rotation), found.translation)
    )
    distances = np.linalg.norm((found.apply(centres) - positions[known])[:, :2], axis=1)
    sigma = max(MIN_PRIOR_SIGMA_M, float(np.median(distances)) / RAYLEIGH_MEDIAN)
    priors, places = [], with_heights(positions)
    for row in known:
        up = sigma if np.isfinite(positions[row, 2]) else UNKNOWN_ALTITUDE_SIGMA_M
        priors.append(
            pycolmap.PosePrior(
                corr_data_id=images[row].data_id,
                position=places[row],
                position_covariance=np.diag([sigma**2, sigma**2, up**2]),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
    options = pycolmap.PosePriorBundleAdjustmentOptions()
    options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    pycolmap.create_pose_prior_bundle_adjuster(
        pycolmap.BundleAdjustmentOptions(print_summary=False), options, config, priors, model
    ).solve()
    model.update_point_3d_errors()
