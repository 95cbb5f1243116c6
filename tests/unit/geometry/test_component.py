"""Components as they are stored, and damaged ones."""

from __future__ import annotations

import io

import numpy as np
import pytest

from shared.geometry.component import Component, quaternion_of, rotation_matrix
from shared.geometry.frames import rotation_of_vector
from tests.support.reconstructed_scene import ReconstructedScene


@pytest.fixture(scope="module")
def component() -> Component:
    return ReconstructedScene(photos=3, points=50).component


def changed(component: Component, **arrays: object) -> bytes:
    with np.load(io.BytesIO(component.encode())) as file:
        stored = {name: file[name] for name in file.files}
    buffer = io.BytesIO()
    np.savez(buffer, **{**stored, **arrays})
    return buffer.getvalue()


def test_component_is_read_as_it_was_stored(component: Component) -> None:
    read = Component.decode(component.encode())
    assert (read.photo_ids, read.cameras) == (component.photo_ids, component.cameras)
    for name in ("rotations", "translations", "points", "covariances", "observations"):
        np.testing.assert_array_equal(getattr(read, name), getattr(component, name))
    for one, other in zip(read.point_numbers, component.point_numbers, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(read.centres(), component.centres())


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"points": np.zeros((3, 3))}, "50 covariances|covariances for 3 points"),
        ({"points": np.full((50, 3), np.nan)}, "not finite"),
        ({"rotations": np.zeros((3, 4))}, "unit quaternion"),
        ({"rotations": np.zeros((3, 3))}, "of shape"),
        ({"camera_numbers": np.full(3, 1, np.int32)}, "camera that is not there"),
        ({"observations": np.zeros(50)}, "float64"),
        ({"keypoints": np.array([1, 2, 3], np.int32)}, "6 keypoints"),
        ({"cameras": np.zeros((1, 4))}, "focal length"),
        ({"point_numbers": np.array(["pickled", None], object)}, "pickle"),
    ],
)
def test_damaged_component_is_a_value_error(
    component: Component, arrays: dict[str, np.ndarray], problem: str
) -> None:
    with pytest.raises(ValueError, match=problem):
        Component.decode(changed(component, **arrays))


def test_keypoint_of_a_missing_point_is_a_value_error(component: Component) -> None:
    numbers = np.concatenate(component.point_numbers)
    numbers[0] = 50
    with pytest.raises(ValueError, match="not there"):
        Component.decode(changed(component, point_numbers=numbers))


@pytest.mark.parametrize("cut", [0, 1, 100, -1000, -1])
def test_truncated_component_is_a_value_error(component: Component, cut: int) -> None:
    with pytest.raises(ValueError, match="no component"):
        Component.decode(component.encode()[:cut])


def test_every_changed_byte_is_noticed_or_harmless(component: Component) -> None:
    data = component.encode()
    rng = np.random.default_rng(0)
    for position in rng.choice(len(data), 200, replace=False):
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        try:
            Component.decode(bytes(damaged))
        except ValueError:
            continue


@pytest.mark.parametrize("vector", [(0, 0, 0), (3.14159, 0, 0), (0, -2, 2.4), (1e-9, 0, 0)])
def test_quaternions_and_matrices_are_the_same_rotations(vector: tuple[float, ...]) -> None:
    rotation = rotation_of_vector(np.array(vector, float))
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation_matrix(quaternion_of(rotation)), rotation, atol=1e-12)
