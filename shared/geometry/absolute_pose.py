"""Absolute pose: where a camera is from the points that it sees.

poselib finds the pose that most pairs agree with. It neither refines a focal length nor returns a
covariance, so the last steps are done here, in NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import poselib
from numpy.typing import NDArray

from shared.geometry.cameras import MAX_FOCAL_LENGTH, MIN_FOCAL_LENGTH, Camera, Floats
from shared.geometry.frames import cross_matrices, rotation_of_vector
from shared.matching.features import WORKING_SIDE

MIN_PAIRS = 6
MAX_ERROR_PIXELS = 5.0
"""at WORKING_SIDE, of an inlier"""
LOSS_SCALE_PIXELS = 1.0
RANSAC = {"min_iterations": 100, "max_iterations": 3000, "seed": 0}
SAMPLED_PAIRS = 400
"""of which poselib finds a start; all refine it"""
FOCAL_STARTS = (0.55, 0.7, 0.85, 1.05, 1.4, 2.0)
"""Focal lengths in longer sides that are tried if none is known"""
REFINED_STARTS = 3
FOCAL_TIE_SHARE = 0.9
"""Focal lengths with such a share of the best one's inliers are as likely"""
ITERATIONS = 25
UNKNOWN_FOCAL_SIGMA = 10.0
"""ln: no knowledge at all"""
PARAMETERS = 10
"""Centre, turn, ln(focal length), principal point and radial distortion"""


@dataclass(frozen=True, slots=True)
class LensSigmas:
    """How far a lens may differ from what is known of it: standard deviations."""

    principal_point: float
    """of the longer side, in each direction"""
    radial: float


@dataclass(frozen=True, slots=True)
class AbsolutePose:
    """The pose of a camera with its uncertainty."""

    rotation: Floats
    """(3, 3) from the points' frame to the camera's axes"""
    position: Floats
    """(3,) of the camera's centre"""
    camera: Camera
    covariance: Floats
    """(6, 6) of the centre, and of a turn of the camera in the points' frame (radians)"""
    focal_sigma: float
    """standard deviation of ln(focal length)"""
    is_inlier: NDArray[np.bool_]
    """(m,)"""


def estimate_absolute_pose(
    pixels: Floats,
    points: Floats,
    camera: Camera,
    focal_sigma: float | None,
    covariances: Floats | None = None,
    lens: LensSigmas | None = None,
) -> AbsolutePose | None:
    """Return the pose that most pairs agree with; None if there is none.

    Args:
        pixels: (m, 2) in the photo.
        points: (m, 3) the point that each pixel may be.
        camera: of the photo. Its focal length is ignored if `focal_sigma` is None.
        focal_sigma: relative standard deviation of the focal length; None if it is unknown.
        covariances: (m, 3, 3) of the points, for keypoints of one pixel at WORKING_SIDE.
        lens: With it, principal point and distortion are estimated around those of `camera`, and
            their errors are in the covariance. Without, they are exactly those of `camera`.
    """
    if len(pixels) < MIN_PAIRS:
        return None
    unit = max(camera.width, camera.height) / WORKING_SIDE
    options = {**RANSAC, "max_reproj_error": MAX_ERROR_PIXELS * unit}
    sample = np.random.default_rng(0).permutation(len(pixels))[:SAMPLED_PAIRS]
    starts = [camera.focal_length] if focal_sigma is not None else FOCAL_STARTS
    fits = []
    for start in starts:
        tried = camera.with_focal_length(start)
        found, info = poselib.estimate_absolute_pose(
            pixels[sample], points[sample], tried.as_poselib(), options, {}
        )
        if info["num_inliers"] >= MIN_PAIRS:
            position = -found.R.T @ found.t
            fits.append(_Fit(pixels, points, covariances, tried, found.R, position))
    refined = sorted(fits, key=lambda fit: fit.cost)[:REFINED_STARTS]
    weights = np.zeros(PARAMETERS)
    sigma = UNKNOWN_FOCAL_SIGMA if focal_sigma is None else max(focal_sigma, 1e-6)
    weights[6] = sigma**-2
    if lens is not None:
        weights[7:9] = (lens.principal_point * WORKING_SIDE) ** -2
        weights[9] = lens.radial**-2
    for fit in refined:
        fit.refine(weights)
    best = min(refined, key=lambda fit: fit.cost, default=None)
    if best is None or best.is_inlier.sum() < MIN_PAIRS:
        return None
    enough = FOCAL_TIE_SHARE * best.is_inlier.sum()
    return best.pose(weights, [fit for fit in refined if fit.is_inlier.sum() >= enough])


class _Fit:
    """A pose that is refined."""

    def __init__(
        self,
        pixels: Floats,
        points: Floats,
        covariances: Floats | None,
        camera: Camera,
        rotation: Floats,
        position: Floats,
    ) -> None:
        self.pixels, self.points, self.covariances = pixels, points, covariances
        self.unit = max(camera.width, camera.height) / WORKING_SIDE
        self.camera, self.rotation, self.position = camera, rotation, position
        self.start = camera
        self.shift = np.zeros(2)
        self._measure()

    def _measure(self) -> None:
        """Compute errors, cost and inliers of the pose."""
        offsets = self.points - self.position
        self.seen = offsets @ self.rotation.T
        self.offsets = offsets
        in_front = self.seen[:, 2] > 0
        self.seen[~in_front, 2] = np.inf
        self.errors = (self.pixels - self.camera.project(self.seen)) / self.unit - self.shift
        squares = np.where(in_front, np.sum(self.errors**2, axis=1), np.inf)
        # Cauchy's loss tells apart poses of as many inliers by those that agree closely.
        bounded = np.minimum(squares, MAX_ERROR_PIXELS**2)
        self.cost = float(np.log1p(bounded / LOSS_SCALE_PIXELS**2).sum())
        self.is_inlier: NDArray[np.bool_] = squares < MAX_ERROR_PIXELS**2

    def refine(self, priors: Floats) -> None:
        """Refine by damped Gauss-Newton steps that are weighted as Cauchy's loss does.

        Args:
            priors: (PARAMETERS,) weights of the prior values; the lens stays as it is with 0.
        """
        damping = 1e-3
        for _ in range(ITERATIONS):
            rows, errors, weights = self._linearise(priors)
            weighted = rows * weights[:, None, None]
            normal = np.einsum("mik,mil->kl", weighted, rows)
            gradient = np.einsum("mik,mi->k", weighted, errors)
            normal += np.diag(priors)
            off = np.log(self.camera.focal_pixels / self.start.focal_pixels)
            gradient[6] -= priors[6] * off
            gradient[7:9] -= priors[7:9] * self.shift
            gradient[9] -= priors[9] * (self.camera.radial - self.start.radial)
            damped = normal + np.diag(damping * np.diag(normal) + (priors == 0) * 1e-9)
            step = np.linalg.solve(damped, gradient)
            before = self.rotation, self.position, self.camera, self.shift, self.cost
            self.position = self.position + step[:3]
            self.rotation = self.rotation @ rotation_of_vector(-step[3:6])
            focal = self.camera.focal_length * float(np.exp(np.clip(step[6], -0.3, 0.3)))
            focal = float(np.clip(focal, MIN_FOCAL_LENGTH, MAX_FOCAL_LENGTH))
            radial = self.camera.radial + float(step[9])
            self.camera = replace(self.camera.with_focal_length(focal), radial=radial)
            self.shift = self.shift + step[7:9]
            self._measure()
            if self.cost > before[4] * (1 + 1e-9):
                self.rotation, self.position, self.camera, self.shift, _ = before
                self._measure()
                damping *= 10
                if damping > 1e3:
                    break
                continue
            damping = max(damping / 10, 1e-9)
            if before[4] - self.cost < 1e-6 * self.cost:
                break

    def pose(self, priors: Floats, others: Sequence[_Fit]) -> AbsolutePose:
        """Return the pose; its covariance is that of the inliers, scaled by their errors'.

        The covariance reaches as far as the poses that are as likely: of flat scenes, several focal
        lengths explain the matches.
        """
        rows, errors, _ = self._linearise(priors)
        count = len(errors)
        variance = float(np.sum(errors**2)) / max(1, 2 * count - PARAMETERS)
        normal = np.einsum("mik,mil->kl", rows, rows) / max(variance, 1e-6)
        normal += np.diag(priors)
        covariance = np.linalg.pinv(normal, hermitian=True)
        apart = [self._difference_from(other) for other in others]
        if apart:
            farthest = max(apart, key=lambda each: float(each[:3] @ each[:3]))
            covariance = covariance + np.outer(farthest, farthest)
        return AbsolutePose(
            self.rotation,
            self.position,
            self.camera,
            covariance[:6, :6],
            float(np.sqrt(covariance[6, 6])),
            self.is_inlier,
        )

    def _difference_from(self, other: _Fit) -> Floats:
        """Return the (PARAMETERS,) difference of another fit as the covariance has it."""
        turn = other.rotation.T @ self.rotation
        vector = np.array(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        focal = np.log(other.camera.focal_pixels / self.camera.focal_pixels)
        radial = other.camera.radial - self.camera.radial
        lens = [focal, *(other.shift - self.shift), radial]
        return np.concatenate([other.position - self.position, vector / 2, lens])

    def _linearise(self, priors: Floats) -> tuple[Floats, Floats, Floats]:
        """Return Jacobian (k, 2, PARAMETERS), errors (k, 2) and weights (k,) of the inliers.

        In units of their standard deviations, if keypoints have one pixel at WORKING_SIDE.
        """
        seen, offsets = self.seen[self.is_inlier], self.offsets[self.is_inlier]
        errors = self.errors[self.is_inlier]
        plane = seen[:, :2] / seen[:, 2:]
        square = np.sum(plane**2, axis=1)
        focal, radial = self.camera.focal_pixels / self.unit, self.camera.radial
        of_plane = focal * (
            (1 + radial * square)[:, None, None] * np.eye(2)
            + 2 * radial * plane[:, :, None] * plane[:, None, :]
        )
        of_seen = np.zeros((len(seen), 2, 3))
        of_seen[:, 0, 0] = of_seen[:, 1, 1] = 1
        of_seen[:, :, 2] = -plane
        of_point = of_plane @ of_seen / seen[:, 2, None, None] @ self.rotation
        rows = np.zeros((len(seen), 2, PARAMETERS))
        rows[:, :, :3] = -of_point
        # A turn t of the camera moves what it sees by -t x offset.
        rows[:, :, 3:6] = of_point @ cross_matrices(offsets)
        rows[:, :, 6] = focal * (1 + radial * square)[:, None] * plane
        if priors[9]:
            rows[:, 0, 7] = rows[:, 1, 8] = 1
            rows[:, :, 9] = focal * square[:, None] * plane
        if self.covariances is not None:
            of_pixel = of_point @ self.covariances[self.is_inlier] @ of_point.transpose(0, 2, 1)
            whitening = np.linalg.inv(np.linalg.cholesky(of_pixel + np.eye(2)))
            rows = whitening @ rows
            errors = np.einsum("mij,mj->mi", whitening, errors)
        weights = 1 / (1 + np.sum(errors**2, axis=1) / LOSS_SCALE_PIXELS**2)
        return rows, errors, weights
