"""Mixtures of circular Gaussians on a plane, and their product: what several sources say together.

A source says where a photo may have been taken as a probability density, a sum of circular
Gaussians and a uniform part over a region, for "anywhere else". Sources that are independent given
the true position are combined by the product of their densities (Bayes' rule with a uniform
prior). The product of two Gaussians is a Gaussian, so the product of mixtures is a mixture
(Gaussian sums: Sorenson and Alspach 1971):

    N(x; m, s^2) N(x; n, t^2) = N(m; n, s^2 + t^2) N(x; (m/s^2 + n/t^2) / w, 1/w)
    w = 1/s^2 + 1/t^2

The uniform density is 1 / A with A the area of a circle with the radius REGION_RADIUS_M. A larger
region would make it a stronger evidence that two sources agree; the region of a town is careful.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.geodesy import EARTH_RADIUS_M

REGION_RADIUS_M = 2000.0
REGION_AREA_M2 = math.pi * REGION_RADIUS_M**2
NEGLIGIBLE = 1e-6
"""Weight of a Gaussian that is left out"""
SAMPLES = 64
"""Points that a Gaussian is integrated with"""
CENTRES = 30
"""Number of Gaussians that are tried as the centre of a circle"""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Plane:
    """Metres east and north of a point; precise within tens of kilometres of it."""

    latitude: float
    longitude: float

    def to_metres(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Return (east, north) of a point in degrees."""
        turned = (longitude - self.longitude + 180) % 360 - 180
        east = math.radians(turned) * math.cos(math.radians(self.latitude))
        return EARTH_RADIUS_M * east, EARTH_RADIUS_M * math.radians(latitude - self.latitude)

    def to_degrees(self, east: float, north: float) -> tuple[float, float]:
        """Return (latitude, longitude) of a point in metres."""
        shrink = max(math.cos(math.radians(self.latitude)), 1e-6)
        longitude = self.longitude + math.degrees(east / EARTH_RADIUS_M / shrink)
        latitude = self.latitude + math.degrees(north / EARTH_RADIUS_M)
        return max(-90.0, min(90.0, latitude)), (longitude + 180) % 360 - 180


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """A probability density on a plane. The weights and `uniform` add up to 1."""

    means: FloatArray
    """(n, 2) metres"""
    sigmas: FloatArray
    """(n,) standard deviations in metres, in each direction"""
    weights: FloatArray
    """(n,)"""
    uniform: float
    """weight of the uniform part"""

    @classmethod
    def of(
        cls, components: Sequence[tuple[tuple[float, float], float, float]], uniform: float
    ) -> Mixture:
        """Build a mixture from (mean, sigma, weight), and normalise it."""
        means, sigmas, weights = zip(*components, strict=True) if components else ((), (), ())
        return _normalised(
            np.array(means, dtype=np.float64).reshape(-1, 2),
            np.array(sigmas, dtype=np.float64),
            np.array(weights, dtype=np.float64),
            uniform,
        )

    def times(self, other: Mixture) -> Mixture:
        """Return the normalised product of two densities."""
        precisions = self.sigmas[:, None] ** -2 + other.sigmas[None, :] ** -2
        variances = self.sigmas[:, None] ** 2 + other.sigmas[None, :] ** 2
        squares = ((self.means[:, None] - other.means[None]) ** 2).sum(axis=2)
        agreement = np.exp(-squares / (2 * variances)) / (2 * np.pi * variances) * REGION_AREA_M2
        weighted = (
            self.means[:, None] * self.sigmas[:, None, None] ** -2
            + other.means[None] * other.sigmas[None, :, None] ** -2
        )
        means = weighted / precisions[:, :, None]
        weights = self.weights[:, None] * other.weights[None, :] * agreement
        return _normalised(
            np.concatenate([means.reshape(-1, 2), self.means, other.means]),
            np.concatenate([precisions.ravel() ** -0.5, self.sigmas, other.sigmas]),
            np.concatenate(
                [weights.ravel(), self.weights * other.uniform, other.weights * self.uniform]
            ),
            self.uniform * other.uniform,
        )

    def best_circle(self, radius_m: float) -> tuple[tuple[float, float], float]:
        """Return the centre of a circle of a radius that is very probable, and its probability.

        The mixture has a Gaussian.
        The centre is the mean within the most probable circle around one of the largest Gaussians.
        """
        points, weights = self._points()
        tried = self.means[np.argsort(-self.weights, kind="stable")[:CENTRES]]
        inside = _within(points, tried, radius_m)
        members = weights * inside[int((inside @ weights).argmax())]
        centre = (members @ points) / max(float(members.sum()), 1e-12)
        probability = float(_within(points, centre[None], radius_m)[0] @ weights)
        return (float(centre[0]), float(centre[1])), min(1.0, probability)

    def probability_within(self, centre: tuple[float, float], radius_m: float) -> float:
        """Return the probability of a circle; of the uniform part, the share of its area."""
        points, weights = self._points()
        gaussians = float(_within(points, np.array([centre]), radius_m)[0] @ weights)
        return gaussians + self.uniform * min(1.0, (radius_m / REGION_RADIUS_M) ** 2)

    def radius_m(self, centre: tuple[float, float], share: float) -> float:
        """Return the radius around a centre that holds a share of the Gaussians' weight."""
        points, weights = self._points()
        distances = np.hypot(*(points - np.array(centre)).T)
        order = np.argsort(distances, kind="stable")
        reached = np.cumsum(weights[order]) >= share * weights.sum()
        return float(distances[order][int(reached.argmax())])

    def _points(self) -> tuple[FloatArray, FloatArray]:
        """Return (n * SAMPLES, 2) points of equal weight within each Gaussian, and their weights.

        They lie on a sunflower spiral at the quantiles of the Rayleigh distribution of the radius,
        and opposite, so that their mean is that of the Gaussian.
        """
        numbers = np.arange(SAMPLES // 2)
        radii = np.sqrt(-2 * np.log1p(-(2 * numbers + 1) / SAMPLES))
        angles = numbers * math.pi * (3 - math.sqrt(5))
        spiral = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
        spiral = np.concatenate([spiral, -spiral])
        points = self.means[:, None] + self.sigmas[:, None, None] * spiral[None]
        return points.reshape(-1, 2), np.repeat(self.weights / SAMPLES, SAMPLES)


def _normalised(
    means: FloatArray, sigmas: FloatArray, weights: FloatArray, uniform: float
) -> Mixture:
    total = float(weights.sum()) + uniform
    kept = weights > NEGLIGIBLE * total
    total = float(weights[kept].sum()) + uniform
    return Mixture(means[kept], sigmas[kept], weights[kept] / total, uniform / total)


def _within(points: FloatArray, centres: FloatArray, radius_m: float) -> FloatArray:
    """Return (centres, points) 1.0 where a point is within the radius of a centre, else 0.0."""
    squares = ((points[None] - centres[:, None]) ** 2).sum(axis=2)
    inside: FloatArray = (squares <= radius_m**2).astype(np.float64)
    return inside
