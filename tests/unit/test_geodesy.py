"""Distances on the sphere: known ones, tiny ones, and those where arithmetic is hard."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given

from shared.geodesy import (
    distance_m,
    distances_m,
    flush_to_zero,
    latitude_bounds,
    weighted_centroid,
)
from tests.unit.search.photo_filters import HALF_EARTH_M, metres, points

DEGREE_M = HALF_EARTH_M / 180
Point = tuple[float, float]


@pytest.mark.parametrize(
    ("one", "other", "expected_m"),
    [
        pytest.param((48.8566, 2.3522), (51.5074, -0.1278), 343_556.5349, id="Paris to London"),
        pytest.param((0, 179.5), (0, -179.5), DEGREE_M, id="across the antimeridian"),
        pytest.param((90, 10), (90, -170), 0, id="a pole has every longitude"),
        pytest.param((37, -122), (-37, 58), HALF_EARTH_M, id="antipodes elsewhere"),
        pytest.param((0, 0), (1e-6, 180), HALF_EARTH_M - DEGREE_M / 1e6, id="nearly antipodes"),
    ],
)
def test_distances_equal_published_ones(one: Point, other: Point, expected_m: float) -> None:
    for here, there in ((one, other), (other, one)):
        assert distance_m(*here, *there) == pytest.approx(expected_m, abs=0.001)


@given(points, points)
@example((0.0, 0.0), (5e-324, 180.0))
def test_a_distance_is_exact_to_a_millimetre_everywhere(one: Point, other: Point) -> None:
    exact = metres(*map(Fraction, one), *map(Fraction, other))
    found = distance_m(*one, *other)
    assert found == pytest.approx(exact, abs=0.001)
    assert found <= HALF_EARTH_M
    assert distance_m(*one, *one) == 0


def test_many_distances_at_once_are_those_of_one_at_a_time() -> None:
    chance = np.random.default_rng(1)
    latitudes, longitudes = chance.uniform(-90, 90, 200), chance.uniform(-180, 180, 200)
    latitudes[3] = longitudes[3] = np.nan
    found = distances_m(12.5, -170, latitudes, longitudes)
    assert math.isnan(found[3])
    for index in set(range(200)) - {3}:
        expected = distance_m(12.5, -170, latitudes[index], longitudes[index])
        assert found[index] == pytest.approx(expected, abs=1e-6)


@given(points, points)
def test_nothing_within_the_radius_lies_outside_its_band(one: Point, other: Point) -> None:
    south, north = latitude_bounds(one[0], distance_m(*one, *other))
    assert south <= other[0] <= north
    south, north = latitude_bounds(one[0], 100_000)
    assert north - south == pytest.approx(200_000 / DEGREE_M)


@pytest.mark.parametrize(
    ("spots", "weights", "expected"),
    [
        ([(10, 20)], [3], (10, 20)),
        ([(0, 179), (0, -179)], [1, 1], (0, 180)),
        ([(0, 10), (0, 20), (50, 50)], [1, 1, 0], (0, 15)),
        ([(80, 0), (80, 90), (80, 180), (80, -90)], [1, 1, 1, 1], (90, None)),
    ],
)
def test_the_centre_of_points_lies_between_them(
    spots: list[Point], weights: list[float], expected: tuple[float, float | None]
) -> None:
    latitudes, longitudes = np.array(spots, dtype=np.float64).T
    latitude, longitude = weighted_centroid(
        latitudes, longitudes, np.array(weights, dtype=np.float64)
    )
    assert latitude == pytest.approx(expected[0], abs=1e-9)
    if expected[1] is not None:
        assert abs(longitude) == pytest.approx(expected[1], abs=1e-9)


def test_denormal_coordinates_are_flushed_to_zero() -> None:
    assert [flush_to_zero(degrees) for degrees in (5e-324, -1e-13, 0.0)] == [0, 0, 0]
    assert [flush_to_zero(degrees) for degrees in (-1e-12, 45.07, -180.0)] == [
        -1e-12,
        45.07,
        -180.0,
    ]
