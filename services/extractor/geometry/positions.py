"""Models of pycolmap beside the positions of their photos: priors, and photos at a wrong place.

Two photos of a plane have two relative poses that explain their matches (Longuet-Higgins, Proc. R.
Soc. B 227, 1986). A model that begins with the wrong one is bent, and contradicts other matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.evidence import (
    MIN_BLOCK,
    RAYLEIGH_MEDIAN,
    best_pairs,
    find_misplaced,
    fit_to_positions,
    positions_of,
    with_heights,
)
from services.extractor.geometry.lookalikes import find_lookalikes
from services.extractor.geometry.matching import VerifiedMatches
from services.extractor.geometry.pairs import Pairs
from services.extractor.geometry.pycolmap_models import PhotoToMap, component_of, require_pycolmap
from shared.geometry.frames import MIN_AGREEING_SHARE, UNKNOWN_ALTITUDE_SIGMA_M
from shared.matching.verification import MAX_EPIPOLAR_ERROR_PIXELS

MIN_PRIOR_SIGMA_M = 0.02
"""Least standard deviation of coordinates: that of a survey"""
LOSS_SCALE_PIXELS = 0.5
"""Observations that are farther off count less and less: about the median error of XFeat"""


def misplaced_photos(
    model: Any,
    photos: Sequence[PhotoToMap],
    matches: VerifiedMatches,
    is_used: NDArray[np.bool_],
) -> tuple[set[str], NDArray[np.bool_]]:
    """Return the names of a model's misplaced photos, and the (m,) matches that led there.

    They contradict their coordinates or their best matches, have more matches with one photo that
    is not in the model than with all that are, or are a block that only looks like the rest. If
    many contradict their best matches, the model is bent: all are misplaced, by those matches.

    Args:
        is_used: (m,) matches that the model was made of; all tell whether it is right.
    """
    component = component_of(model, {str(photo.id): photo for photo in photos})
    positions = positions_of(component.photo_ids, photos)
    rows = {id_: row for row, id_ in enumerate(component.photo_ids)}
    numbers = np.array([rows.get(id_, -1) for id_ in matches.photo_ids], np.int32)[matches.pairs]
    inside = np.flatnonzero((numbers >= 0).all(axis=1))
    used = inside[is_used[inside]]
    counts = np.array([len(keypoints) for keypoints in matches.keypoints], int)
    blocks, excess = find_lookalikes(component, numbers[inside])
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
    crossing = (numbers.min(axis=1) < 0) & (numbers.max(axis=1) >= 0)
    elsewhere = np.zeros(len(positions))
    np.maximum.at(elsewhere, numbers[crossing].max(axis=1), counts[crossing])
    here = np.bincount(numbers[inside].ravel(), np.repeat(counts[inside], 2), len(positions))
    misplaced |= elsewhere > here
    images = [model.image(number) for number in sorted(model.reg_image_ids())]
    keypoints = [matches.keypoints[row] for row in used.tolist()]
    contradicted = find_contradicted(images, numbers[used], keypoints)
    is_bent = contradicted.sum() > (1 - MIN_AGREEING_SHARE) * len(contradicted)
    contradicts[used] |= is_bent & contradicted[numbers[used]].any(axis=1)
    misplaced |= contradicted | is_bent
    names = {images[row].name for row in np.flatnonzero(misplaced).tolist()}
    return names, contradicts & is_used


def find_contradicted(
    images: Sequence[Any], pairs: Pairs, keypoints: Sequence[NDArray[np.integer[Any]]]
) -> NDArray[np.bool_]:
    """Return the (n,) photos whose best matches a model contradicts.

    A match agrees if it is near the epipolar lines and not of two points. The photo that is
    contradicted most is left out first, and its matches count for none of the others.

    Args:
        images: of the model, at the working size.
        pairs: (m, 2) rows of photos that match.
        keypoints: for each pair (k, 2) those of its matches.
    """
    pycolmap = require_pycolmap()
    rays = [image.camera.cam_from_img(image.points2D) for image in images]
    points = [np.array([p.point3D_id for p in image.points2D], np.uint64) for image in images]

    def count_agreeing(pair: Sequence[int], matched: NDArray[np.integer[Any]]) -> int:
        (one, other), (seen, also_seen) = pair, matched.T
        move = images[other].cam_from_world() * images[one].cam_from_world().inverse()
        squares = pycolmap.compute_squared_sampson_error(
            rays[one][seen], rays[other][also_seen], pycolmap.essential_matrix_from_pose(move)
        )
        limit = 2 * MAX_EPIPOLAR_ERROR_PIXELS / images[one].camera.mean_focal_length()
        ids, others = points[one][seen], points[other][also_seen]
        is_same = (ids == others) | (np.maximum(ids, others) == pycolmap.INVALID_POINT3D_ID)
        return int(np.sum((np.array(squares) <= limit**2) & is_same))

    one, other = pairs.reshape(-1, 2).T
    agreeing = np.array(list(map(count_agreeing, pairs.tolist(), keypoints)), int)
    counts = np.array([len(each) for each in keypoints], int)
    found = np.zeros(len(images), dtype=bool)
    while True:
        best = best_pairs(one, other, np.where(found[one] | found[other], 0, counts))
        agree, of = (
            np.bincount(pairs[best].ravel(), np.repeat(each[best], 2), len(images))
            for each in (agreeing, counts)
        )
        shares = np.divide(agree, of, out=np.ones(len(images)), where=of > 0)
        if shares.min(initial=1.0) >= MIN_AGREEING_SHARE:
            break
        found[shares.argmin()] = True
    return found


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
    positions = positions_of((UUID(image.name) for image in images), photos)
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
