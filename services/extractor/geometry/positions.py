"""Models of pycolmap beside the positions of their photos: priors, and photos at a wrong place."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any
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
from services.extractor.geometry.lookalikes import find_lookalikes
from services.extractor.geometry.matching import VerifiedMatches
from services.extractor.geometry.pycolmap_models import PhotoToMap
from shared.geometry.cameras import Floats
from shared.geometry.component import Component
from shared.geometry.frames import UNKNOWN_ALTITUDE_SIGMA_M

MIN_PRIOR_SIGMA_M = 0.02
"""Least standard deviation of coordinates: that of a survey"""
LOSS_SCALE_PIXELS = 0.5
"""Observations that are farther off count less and less: about the median error of XFeat"""


def _positions(ids: Iterable[UUID], photos: Sequence[PhotoToMap]) -> Floats:
    """Return the positions (n, 3) of photos, NaN where they are unknown."""
    of_id = {photo.id: photo.position for photo in photos}
    unknown = np.full(3, np.nan)
    places = [unknown if of_id[id_] is None else of_id[id_] for id_ in ids]
    return np.array(places, float).reshape(-1, 3)


def misplaced_photos(
    component: Component,
    photos: Sequence[PhotoToMap],
    matches: VerifiedMatches,
    is_used: NDArray[np.bool_],
) -> tuple[set[str], NDArray[np.bool_]]:
    """Return the names of a component's misplaced photos, and the (m,) matches that led there.

    They contradict their coordinates, or are a block that only looks like the rest.

    Args:
        is_used: (m,) matches that the component was made of; all tell whether it is right.
    """
    positions = _positions(component.photo_ids, photos)
    rows = {id_: row for row, id_ in enumerate(component.photo_ids)}
    numbers = np.array([rows.get(id_, -1) for id_ in matches.photo_ids], np.int32)[matches.pairs]
    inside = np.flatnonzero((numbers >= 0).all(axis=1))
    used = inside[is_used[inside]]
    counts = np.array([len(keypoints) for keypoints in matches.keypoints], int)
    blocks, excess = find_lookalikes(component, numbers[inside], counts[inside])
    misplaced, wrong = find_misplaced(
        component.centres(),
        [component.rotation(row) for row in range(len(positions))],
        positions,
        numbers[used],
        counts[used],
        blocks,
    )
    is_alike = misplaced & (blocks > 0)
    contradicts = np.zeros(len(is_used), dtype=bool)
    contradicts[inside] = (is_alike[numbers[inside]].sum(axis=1) == 1) & (excess != 0)
    contradicts[used] |= wrong
    names = {str(component.photo_ids[row]) for row in np.flatnonzero(misplaced)}
    return names, contradicts & is_used


def adjust_to_positions(pycolmap: Any, model: Any, photos: Sequence[PhotoToMap]) -> None:
    """Move a model to the positions of its photos, and adjust it with these as priors.

    Their standard deviation is that of the model's distances from them. Wrong observations hardly
    count.
    """
    images = [model.image(number) for number in sorted(model.reg_image_ids())]
    priors = _move_to_positions(pycolmap, model, images, photos)
    if not priors:
        return
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE_PIXELS
    of_priors = pycolmap.PosePriorBundleAdjustmentOptions()
    of_priors.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    pycolmap.create_pose_prior_bundle_adjuster(options, of_priors, config, priors, model).solve()
    model.update_point_3d_errors()


def _move_to_positions(
    pycolmap: Any, model: Any, images: Sequence[Any], photos: Sequence[PhotoToMap]
) -> list[Any]:
    """Move a model to the positions of its photos, and return these as priors; [] if unknown."""
    positions = _positions((UUID(image.name) for image in images), photos)
    rotations = [image.cam_from_world().rotation.matrix() for image in images]
    known = np.flatnonzero(np.isfinite(positions[:, :2]).all(axis=1))
    if len(known) < MIN_BLOCK:
        return []
    centres = np.array([image.projection_center() for image in images])[known]
    found = fit_to_positions(centres, [rotations[row] for row in known.tolist()], positions[known])
    if found is None:
        return []
    model.transform(
        pycolmap.Sim3d(found.scale, pycolmap.Rotation3d(found.rotation), found.translation)
    )
    distances = np.linalg.norm((found.apply(centres) - positions[known])[:, :2], axis=1)
    sigma = max(MIN_PRIOR_SIGMA_M, float(np.median(distances)) / RAYLEIGH_MEDIAN)
    priors, places = [], with_heights(positions)
    for row in known.tolist():
        up = sigma if np.isfinite(positions[row, 2]) else UNKNOWN_ALTITUDE_SIGMA_M
        priors.append(
            pycolmap.PosePrior(
                corr_data_id=images[row].data_id,
                position=places[row],
                position_covariance=np.diag([sigma**2, sigma**2, up**2]),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    return priors
