"""Distances and boxes on the sphere, the same in Python, NumPy and (see `catalog.base`) in SQL."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

EARTH_RADIUS_M = 6_371_008.8  # mean radius of the GRS 80 ellipsoid (Moritz 2000)

ZERO_TOLERANCE_DEGREES = 1e-12  # less than a micrometre on the ground

DegreesArray = NDArray[np.float64]


def flush_to_zero(degrees: float) -> float:
    """0 for what is next to 0, else the same: PostgreSQL refuses to compute with numbers whose
    squares are too small for a double, and one such photo would end every search."""
    return 0.0 if abs(degrees) < ZERO_TOLERANCE_DEGREES else degrees


def distance_m(
    latitude_1: float, longitude_1: float, latitude_2: float, longitude_2: float
) -> float:
    """Great-circle distance in metres of two points in degrees (haversine, Sinnott 1984).

    Within 0.6 % of the distance on the ellipsoid; exact to a millimetre on the sphere, also for
    points a metre apart, across the antimeridian, at the poles, and near the antipodes: there the
    haversine alone loses metres to rounding, and the distance to the antipode, `g`, decides.
    """
    phi_1, phi_2 = math.radians(latitude_1), math.radians(latitude_2)
    half_lambda = math.radians(longitude_2 - longitude_1) / 2
    shrunk = math.cos(phi_1) * math.cos(phi_2)
    h = math.sin((phi_2 - phi_1) / 2) ** 2 + shrunk * math.sin(half_lambda) ** 2
    g = math.sin((phi_2 + phi_1) / 2) ** 2 + shrunk * math.cos(half_lambda) ** 2
    return 2 * EARTH_RADIUS_M * math.atan2(math.sqrt(h), math.sqrt(g))


def distances_m(
    latitude: float, longitude: float, latitudes: DegreesArray, longitudes: DegreesArray
) -> DegreesArray:
    """`distance_m` from one point to (n,) others; NaN where a point has no coordinates."""
    phi, phis = np.radians(latitude), np.radians(latitudes)
    half_lambdas = np.radians(longitudes - longitude) / 2
    shrunk = np.cos(phi) * np.cos(phis)
    h = np.sin((phis - phi) / 2) ** 2 + shrunk * np.sin(half_lambdas) ** 2
    g = np.sin((phis + phi) / 2) ** 2 + shrunk * np.cos(half_lambdas) ** 2
    metres: DegreesArray = 2 * EARTH_RADIUS_M * np.arctan2(np.sqrt(h), np.sqrt(g))
    return metres


def latitude_bounds(latitude: float, radius_m: float) -> tuple[float, float]:
    """Latitudes outside of which nothing lies within `radius_m`: what an index can sort out."""
    reach = math.degrees(radius_m / EARTH_RADIUS_M) * (1 + 1e-9) + 1e-9
    return latitude - reach, latitude + reach


def longitude_half_width(latitude: float, radius_m: float) -> float | None:
    """Degrees of longitude to both sides, outside of which nothing lies within `radius_m` of a
    point at this latitude; None where that is every longitude, or nearly so (around a pole)."""
    angle = radius_m / EARTH_RADIUS_M
    if angle >= math.pi / 2:
        return None
    sine = math.sin(angle) / max(math.cos(math.radians(latitude)), ZERO_TOLERANCE_DEGREES)
    if sine > 0.999:  # from here on the arc's own rounding grows
        return None
    return math.degrees(math.asin(sine)) * (1 + 1e-9) + 1e-9


def weighted_centroid(
    latitudes: DegreesArray, longitudes: DegreesArray, weights: DegreesArray
) -> tuple[float, float]:
    """The weighted centre of (n,) points as latitude and longitude: the mean of their vectors.

    So that points on both sides of the antimeridian or around a pole meet between each other.
    """
    phi, lam = np.radians(latitudes), np.radians(longitudes)
    x = float(np.sum(weights * np.cos(phi) * np.cos(lam)))
    y = float(np.sum(weights * np.cos(phi) * np.sin(lam)))
    z = float(np.sum(weights * np.sin(phi)))
    return math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x))
