"""Distances and bounding boxes on the sphere, in Python and NumPy.

`shared.catalog.database.base` has the same formulas in SQL.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

EARTH_RADIUS_M = 6_371_008.8  # mean radius of the GRS 80 ellipsoid (Moritz 2000)

ZERO_TOLERANCE_DEGREES = 1e-12  # less than a micrometre on the ground

DegreesArray = NDArray[np.float64]


def flush_to_zero(degrees: float) -> float:
    """Return 0 for a value within ZERO_TOLERANCE_DEGREES of 0, otherwise the value.

    PostgreSQL raises an underflow error for numbers whose squares are too small for a double, and
    one such photo would make every search fail.
    """
    return 0.0 if abs(degrees) < ZERO_TOLERANCE_DEGREES else degrees


def distance_m(
    latitude_1: float, longitude_1: float, latitude_2: float, longitude_2: float
) -> float:
    """Return the great-circle distance between two points (haversine, Sinnott 1984).

    The result is within 0.6 % of the distance on the ellipsoid, and exact to a millimetre on the
    sphere, also for points a metre apart, across the antimeridian, at the poles and near the
    antipodes. For nearly antipodal points the haversine `h` alone loses metres to rounding;
    therefore the angle is atan2(sqrt(h), sqrt(g)), with `g` = 1 - h computed without cancellation.

    Args:
        latitude_1, longitude_1, latitude_2, longitude_2: degrees.

    Returns:
        Metres.
    """
    phi_1, phi_2 = math.radians(latitude_1), math.radians(latitude_2)
    half_lambda = math.radians(longitude_2 - longitude_1) / 2
    cos_product = math.cos(phi_1) * math.cos(phi_2)
    h = math.sin((phi_2 - phi_1) / 2) ** 2 + cos_product * math.sin(half_lambda) ** 2
    g = math.sin((phi_2 + phi_1) / 2) ** 2 + cos_product * math.cos(half_lambda) ** 2
    return 2 * EARTH_RADIUS_M * math.atan2(math.sqrt(h), math.sqrt(g))


def distances_m(
    latitude: float, longitude: float, latitudes: DegreesArray, longitudes: DegreesArray
) -> DegreesArray:
    """Return `distance_m` from one point to (n,) points; NaN where a point has no coordinates."""
    phi, phis = np.radians(latitude), np.radians(latitudes)
    half_lambdas = np.radians(longitudes - longitude) / 2
    cos_product = np.cos(phi) * np.cos(phis)
    h = np.sin((phis - phi) / 2) ** 2 + cos_product * np.sin(half_lambdas) ** 2
    g = np.sin((phis + phi) / 2) ** 2 + cos_product * np.cos(half_lambdas) ** 2
    metres: DegreesArray = 2 * EARTH_RADIUS_M * np.arctan2(np.sqrt(h), np.sqrt(g))
    return metres


def latitude_bounds(latitude: float, radius_m: float) -> tuple[float, float]:
    """Return the southern and northern latitude, in degrees, of all points within `radius_m`.

    For a query that uses the index on the latitude; it also finds points farther away.
    """
    margin = math.degrees(radius_m / EARTH_RADIUS_M) * (1 + 1e-9) + 1e-9
    return latitude - margin, latitude + margin


def longitude_half_width(latitude: float, radius_m: float) -> float | None:
    """Return the half width, in degrees of longitude, that encloses every point within `radius_m`.

    None where that is every longitude, or nearly so (around a pole).
    """
    angle = radius_m / EARTH_RADIUS_M
    if angle >= math.pi / 2:
        return None
    sine = math.sin(angle) / max(math.cos(math.radians(latitude)), ZERO_TOLERANCE_DEGREES)
    if sine > 0.999:  # beyond, the rounding error of asin grows
        return None
    return math.degrees(math.asin(sine)) * (1 + 1e-9) + 1e-9


def weighted_centroid(
    latitudes: DegreesArray, longitudes: DegreesArray, weights: DegreesArray
) -> tuple[float, float]:
    """Return latitude and longitude of the weighted centroid of (n,) points, in degrees.

    It is the direction of the weighted mean of their unit vectors, so that points on both sides of
    the antimeridian or around a pole have their centroid between them.
    """
    phi, lam = np.radians(latitudes), np.radians(longitudes)
    x = float(np.sum(weights * np.cos(phi) * np.cos(lam)))
    y = float(np.sum(weights * np.cos(phi) * np.sin(lam)))
    z = float(np.sum(weights * np.sin(phi)))
    return math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x))
