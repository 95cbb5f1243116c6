"""Local planes, alignments with coordinates, and attitudes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.errors import Unprocessable
from shared.geodesy import distance_m
from shared.geometry.frames import (
    Alignment,
    EastNorthUp,
    Similarity,
    align,
    attitude_of,
    geopose_rotation,
    rotation_of_vector,
)

PLACES = {
    "Turin": (45.07, 7.68),
    "the equator": (0.0, 0.0),
    "the antimeridian": (-17.5, 179.9999),
    "close to the north pole": (89.9995, -120.0),
    "the south pole": (-90.0, 0.0),
}
TURN = rotation_of_vector(np.array([0.3, -0.2, 2.0]))

metres = st.floats(-2000, 2000)


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@given(east=metres, north=metres, up=metres)
def test_local_metres_and_coordinates_are_inverse(
    place: tuple[float, float], east: float, north: float, up: float
) -> None:
    plane = EastNorthUp(*place, 250.0)
    there = plane.to_geographic(np.array([east, north, up]))
    assert -90 <= there.latitude <= 90
    assert -180 <= there.longitude <= 180
    back = plane.from_geographic([there.latitude], [there.longitude], [there.altitude_m])
    np.testing.assert_allclose(back[0], [east, north, up], atol=1e-5)
    # The sphere of `distance_m` differs by up to 0.6 %, and a height spreads the plane.
    far = math.hypot(east, north)
    assert distance_m(*place, there.latitude, there.longitude) == pytest.approx(
        far, rel=0.008, abs=0.1 + far * 0.0004
    )


def test_local_axes_point_east_north_and_up() -> None:
    plane = EastNorthUp(*PLACES["the antimeridian"])
    east = plane.to_geographic(np.array([100.0, 0.0, 0.0]))
    assert east.longitude == pytest.approx(-179.99915, abs=1e-4)
    assert east.latitude == pytest.approx(-17.5, abs=1e-6)
    north = plane.to_geographic(np.array([0.0, 100.0, 0.0]))
    assert north.latitude == pytest.approx(-17.5 + 100 / 110_650, abs=1e-6)
    assert plane.to_geographic(np.array([0.0, 0.0, 7.0])).altitude_m == pytest.approx(7)


def geographic(plane: EastNorthUp, metres: np.ndarray) -> np.ndarray:
    there = map(plane.to_geographic, metres)
    return np.array([(each.latitude, each.longitude, each.altitude_m) for each in there]).T


class Walk:
    """Photos of a walk with their coordinates, which are noisy."""

    def __init__(
        self, place: tuple[float, float], count: int = 60, noise_m: float = 2.0, seed: int = 0
    ) -> None:
        rng = np.random.default_rng(seed)
        along = np.linspace(0, 4 * math.pi, count)
        self.enu = np.column_stack([5 * along, 12 * np.sin(along), 1.5 + 0.2 * np.cos(3 * along)])
        self.plane = EastNorthUp(*place, 100.0)
        self.scale = 4.0
        self.centres = (self.enu - (10, 20, 5)) @ TURN / self.scale
        headings = [rotation_of_vector(np.array([0, 0, -h])) for h in along]
        level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks north
        self.rotations = [level @ h.T @ TURN for h in headings]
        self.locate(self.enu + rng.normal(0, noise_m, self.enu.shape))
        self.sigmas = np.full(count, 5.0)

    def locate(self, enu: np.ndarray) -> None:
        self.latitudes, self.longitudes, self.altitudes = geographic(self.plane, enu)

    def align(self) -> Alignment:
        return align(
            self.centres,
            self.rotations,
            self.latitudes,
            self.longitudes,
            self.altitudes,
            self.sigmas,
        )

    def errors(self, found: Alignment) -> np.ndarray:
        """(n, 3) metres in the plane of the walk."""
        there = geographic(found.origin, found.similarity.apply(self.centres))
        metres = self.plane.from_geographic(*there)
        return np.asarray(metres - self.enu)


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_component_is_aligned_with_noisy_coordinates(place: tuple[float, float]) -> None:
    walk = Walk(place)
    found = walk.align()
    assert found.similarity.scale == pytest.approx(walk.scale, rel=0.03)
    assert np.abs(walk.errors(found)).max() < 2
    assert found.is_inlier.sum() > 50
    assert 2 < found.rms_m < 4  # two dimensions of 2 m each


def test_wrong_coordinates_do_not_move_the_others() -> None:
    walk = Walk(PLACES["Turin"], noise_m=0.1)
    walk.latitudes[::4] += 0.002  # 220 m
    found = walk.align()
    assert np.abs(walk.errors(found)).max() < 0.5
    assert not found.is_inlier[::4].any()
    assert found.residuals_m[4] == pytest.approx(222, rel=0.01)


def test_photos_without_altitude_are_aligned_on_flat_ground() -> None:
    walk = Walk(PLACES["Turin"])
    walk.altitudes[:] = np.nan
    found = walk.align()
    assert not found.similarity.knows_altitude
    assert np.abs(walk.errors(found)[:, :2]).max() < 2


def test_photos_without_coordinates_do_not_count() -> None:
    walk = Walk(PLACES["Turin"], noise_m=0.1)
    walk.latitudes[10:30] = walk.longitudes[10:30] = np.nan
    found = walk.align()
    assert np.isnan(found.residuals_m[10:30]).all()
    assert not found.is_inlier[10:30].any()
    assert np.abs(walk.errors(found)).max() < 0.5


def test_street_on_a_line_is_turned_about_it_as_upright_cameras_are() -> None:
    walk = Walk(PLACES["Turin"], noise_m=0.0)
    line = np.linspace(0, 150, len(walk.enu))[:, None] * [0.6, 0.8, 0.0] + [0, 0, 1.5]
    walk.enu, walk.centres = line, (line - (10, 20, 5)) @ TURN / walk.scale
    walk.locate(line)
    found = walk.align()
    assert found.is_on_line
    aside = walk.centres[30] + 20 / walk.scale * TURN[2]  # 20 m above the street
    height = found.similarity.apply(aside)[2] - found.similarity.apply(walk.centres[30])[2]
    assert height == pytest.approx(20, abs=0.1)


def test_bent_model_is_not_aligned() -> None:
    walk = Walk(PLACES["Turin"], noise_m=0.5)
    bend = np.zeros((60, 3))
    bend[42:] = (60, 30, 0)
    walk.centres = walk.centres + bend @ TURN / walk.scale
    with pytest.raises(Unprocessable, match="agree with their coordinates: the reconstruction is"):
        walk.align()


@pytest.mark.parametrize("bias", [False, True], ids=["independent errors", "errors of minutes"])
def test_covariance_contains_the_error_of_the_alignment(bias: bool) -> None:
    squares = []
    for seed in range(20):
        walk = Walk(PLACES["Turin"], seed=seed)
        if bias:
            rng = np.random.default_rng(seed)
            walk.latitudes += 4e-5 * np.repeat(rng.normal(size=12), 5)  # 4.4 m
            walk.longitudes += 6e-5 * np.repeat(rng.normal(size=12), 5)
        found = walk.align()
        error = walk.errors(found)[30]
        covariance = found.similarity.position_covariance(walk.centres[30])
        squares.append(error[:2] @ np.linalg.solve(covariance[:2, :2], error[:2]))
    assert np.mean(np.array(squares) < 6.0) >= 0.85  # 95 % quantile of chi-squared, 2 dimensions
    assert np.median(squares) > (0.05 if bias else 1.2)  # that of chi-squared is 1.39


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("two", "2 of its photos have coordinates, and 3 are needed"),
        ("same", "Its photos are too close to each other for the errors of their coordinates"),
        ("wrong", "from their coordinates: these or the reconstruction are wrong"),
        ("close", "Its photos are too close to each other for the errors of their coordinates"),
    ],
)
def test_component_that_is_not_aligned_has_a_reason(change: str, reason: str) -> None:
    walk = Walk(PLACES["Turin"], noise_m=0.5)
    if change == "two":
        walk.latitudes[2:] = np.nan
    if change == "same":
        walk.longitudes[:], walk.latitudes[:] = walk.longitudes[0], walk.latitudes[0]
    if change == "close":
        walk = Walk(PLACES["Turin"], count=6, noise_m=30)
        walk.sigmas[:] = 30
    if change == "wrong":
        order = np.random.default_rng(0).permutation(40)
        walk.latitudes[:40], walk.longitudes[:40] = walk.latitudes[order], walk.longitudes[order]
    with pytest.raises(Unprocessable, match=reason):
        walk.align()


def test_similarity_is_read_as_it_was_stored() -> None:
    stored = Walk(PLACES["Turin"]).align().similarity
    read = Similarity.from_json(stored.as_json())
    points = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(read.apply(points), stored.apply(points))
    np.testing.assert_array_equal(read.covariance, stored.covariance)


def camera(heading: float, pitch: float, roll: float) -> np.ndarray:
    """The rotation from east-north-up of a camera that was turned by hand."""
    up, right, forward = np.eye(3)[2], np.eye(3)[0], np.eye(3)[1]
    turn = (
        rotation_of_vector(-math.radians(heading) * up)
        @ rotation_of_vector(math.radians(pitch) * right)
        @ rotation_of_vector(math.radians(roll) * forward)
    )
    return np.asarray(np.array([right, -up, forward]) @ turn.T)


@given(st.floats(0, 359.9), st.floats(-89, 89), st.floats(-179, 179))
def test_attitude_is_that_of_a_camera_turned_by_hand(
    heading: float, pitch: float, roll: float
) -> None:
    found = attitude_of(camera(heading, pitch, roll))
    assert (found.heading - heading + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
    assert found.pitch == pytest.approx(pitch, abs=1e-6)
    assert found.roll == pytest.approx(roll, abs=1e-6)


def test_inner_frame_of_geopose_is_forward_left_up() -> None:
    rotation = geopose_rotation(camera(30, 10, 5))
    forward = camera(30, 10, 5)[2]
    np.testing.assert_allclose(rotation[:, 0], forward, atol=1e-12)
    assert rotation[2, 2] > 0.9  # up


def test_camera_that_looks_straight_down_has_a_heading() -> None:
    found = attitude_of(camera(40, -90, 0))
    assert found.heading == pytest.approx(40)
    assert (found.pitch, found.roll) == pytest.approx((-90, 0))
