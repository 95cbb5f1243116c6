"""Distances and boxes on the sphere, the same in Python, NumPy and (see `catalog.base`) in SQL."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

EARTH_RADIUS_M = 6_371_008.8  # mean radius of the GRS 80 ellipsoid (Moritz 2000)

Degrees = NDArray[np.float64]


def distance_m(
    latitude_1: float, longitude_1: float, latitude_2: float, longitude_2: float
) -> float:
    """Great-circle distance in metres of two points in degrees (haversine, Sinnott 1984).

    Within 0.6 % of the distance on the ellipsoid; exact to a millimetre on the sphere, also for
    points a metre apart, across the antimeridian and at the poles.
    """
    phi_1, phi_2 = math.radians(latitude_1), math.radians(latitude_2)
    half_phi = (phi_2 - phi_1) / 2
    half_lambda = math.radians(longitude_2 - longitude_1) / 2
    h = math.sin(half_phi) ** 2 + math.cos(phi_1) * math.cos(phi_2) * math.sin(half_lambda) ** 2
    return 2 * EARTH_RADIUS_M * math.asin(min(1.0, math.sqrt(h)))


def distances_m(
    latitude: float, longitude: float, latitudes: Degrees, longitudes: Degrees
) -> Degrees:
    """`distance_m` from one point to (n,) others; NaN where a point has no coordinates."""
    phi, phis = np.radians(latitude), np.radians(latitudes)
    half_phis = (phis - phi) / 2
    half_lambdas = np.radians(longitudes - longitude) / 2
    h = np.sin(half_phis) ** 2 + np.cos(phi) * np.cos(phis) * np.sin(half_lambdas) ** 2
    metres: Degrees = 2 * EARTH_RADIUS_M * np.arcsin(np.minimum(1.0, np.sqrt(h)))
    return metres


def latitude_band(latitude: float, radius_m: float) -> tuple[float, float]:
    """Latitudes outside of which nothing lies within `radius_m`: what an index can sort out."""
    reach = math.degrees(radius_m / EARTH_RADIUS_M) * (1 + 1e-9) + 1e-9
    return latitude - reach, latitude + reach


def centre_of(latitudes: Degrees, longitudes: Degrees, weights: Degrees) -> tuple[float, float]:
    """The weighted centre of (n,) points as latitude and longitude: the mean of their vectors.

    So that points on both sides of the antimeridian or around a pole meet between each other.
    """
    phi, lam = np.radians(latitudes), np.radians(longitudes)
    x = float(np.sum(weights * np.cos(phi) * np.cos(lam)))
    y = float(np.sum(weights * np.cos(phi) * np.sin(lam)))
    z = float(np.sum(weights * np.sin(phi)))
    return math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x))
