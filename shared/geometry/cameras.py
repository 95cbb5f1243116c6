"""Cameras: the model of COLMAP's SIMPLE_RADIAL, rays of others, and focal lengths from EXIF."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FILM_DIAGONAL_MM = math.hypot(36, 24)
UNITS_MM = {2: 25.4, 3: 10.0}
"""Millimetres of FocalPlaneResolutionUnit (EXIF 2.32): inch and centimetre"""
MIN_FOCAL_LENGTH, MAX_FOCAL_LENGTH = 0.3, 6.0
"""Plausible focal lengths in longer sides: views of 118 and 10 degrees"""


UNKNOWN_FOCAL_LENGTH = 0.9
"""in longer sides, where a guess is needed: between a phone (0.75) and its cropped video"""


class CameraSource(StrEnum):
    """Where the focal length of a query comes from."""

    GIVEN = "given"
    """with the query"""
    EXIF = "exif"
    """from the photo's metadata"""
    MAP = "map"
    """from the photos of the map, which the same camera took"""
    ESTIMATED = "estimated"
    """from the matches, together with the pose"""


CAMERA_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""Models of COLMAP that a query may name, with their parameters in pixels"""
UNDISTORTIONS = 20
"""Fixed-point iterations, as OpenCV's undistortPoints makes five of"""
RAY_TERMS = 10
"""Chebyshev polynomials along each side of a photo: a third of a pixel off at wide lenses' edges"""
MAX_RAY_ANGLE = math.radians(75)
"""Farther from the axis, a pixel's error is more than 15 times as large in a pinhole camera"""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Where the pixels of a camera of any model look, as polynomials of their positions.

    The value (x, y) / |(x, y)| * angle at a pixel has the direction of its ray beside the axis,
    and its angle from it.
    """

    coefficients: Floats
    """(RAY_TERMS, RAY_TERMS, 2) of positions in [-1, 1] from left to right and top to bottom"""
    focal_length: float
    """of the camera, as a multiple of the longer side"""
    camera_key: bytes
    """(32,) of `hash_camera_key`; zero bytes if the photos do not say which camera it was"""
    quarter_turns: int
    """clockwise, by which the photo was turned upright"""

    @classmethod
    def fit(
        cls,
        look: Callable[[Floats], Floats],
        size: tuple[int, int],
        focal_length: float,
        camera_key: bytes,
        quarter_turns: int,
    ) -> Rays:
        """Fit the rays (m, 3) that `look` gives for (m, 2) pixels of a photo of width, height."""
        nodes = np.polynomial.chebyshev.chebpts1(2 * RAY_TERMS)
        places = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
        x, y, z = look((places + 1) / 2 * size).T
        beside = np.hypot(x, y)
        angles = np.arctan2(beside, z) / np.maximum(beside, 1e-12)
        values = np.column_stack([x * angles, y * angles])
        known = np.isfinite(values).all(axis=1)
        across, down = places[known].T
        degrees = (RAY_TERMS - 1, RAY_TERMS - 1)
        terms = np.polynomial.chebyshev.chebvander2d(across, down, degrees)
        found = np.linalg.lstsq(terms, values[known], rcond=None)[0]
        shape = RAY_TERMS, RAY_TERMS, 2
        return cls(found.reshape(shape), focal_length, camera_key, quarter_turns)

    def turned(self, quarter_turns: int) -> Rays:
        """Return the rays for photos that are turned clockwise by so much to be upright."""
        coefficients = self.coefficients
        for _ in range((quarter_turns - self.quarter_turns) % 4):
            # The pixel at (x, y) was at (y, -x), and what was right of the axis is below it.
            flipped = coefficients.swapaxes(0, 1) * (-1.0) ** np.arange(RAY_TERMS)[:, None, None]
            coefficients = np.stack([-flipped[..., 1], flipped[..., 0]], axis=-1)
        return replace(self, coefficients=coefficients, quarter_turns=quarter_turns)

    def undistort(self, pixels: Floats, width: int, height: int) -> Floats:
        """Return where a pinhole camera of this focal length would see what (m, 2) pixels see.

        Its principal point is in the middle. NaN for what is more than MAX_RAY_ANGLE off its axis.
        """
        x, y = (2 * pixels / (width, height) - 1).T
        values = np.polynomial.chebyshev.chebval2d(x, y, self.coefficients).T
        angles = np.hypot(*values.T)
        stretch = np.tan(angles) / np.maximum(angles, 1e-12)
        stretch[angles > MAX_RAY_ANGLE] = np.nan
        longer = max(width, height)
        middle = np.array([width, height]) / 2
        pinhole: Floats = middle + self.focal_length * longer * values * stretch[:, None]
        return pinhole


def hash_camera_key(camera_key: str) -> bytes:
    """Return the 32 bytes that stand for a `PhotoHeader.camera_key`."""
    return hashlib.sha256(camera_key.encode()).digest()


@dataclass(frozen=True, slots=True)
class Camera:
    """COLMAP's SIMPLE_RADIAL with the principal point in the middle of the photo.

    A point (x, y, z) in the camera's axes is projected to the pixels

        (width, height) / 2 + focal_pixels * (1 + radial * r^2) * (x, y) / z

    where r^2 = (x^2 + y^2) / z^2. With `rays`, these are the pixels after `undistort`.
    """

    width: int
    height: int
    focal_pixels: float
    radial: float = 0.0
    rays: Rays | None = field(default=None, compare=False)

    @classmethod
    def of_focal_length(cls, width: int, height: int, focal_length: float) -> Camera:
        """Return a camera without distortion; `focal_length` is a multiple of the longer side."""
        return cls(width, height, focal_length * max(width, height))

    @classmethod
    def of_parameters(cls, model: str, values: Sequence[float], size: tuple[int, int]) -> Camera:
        """Return the camera of CAMERA_PARAMETERS for photos of this width and height.

        Raises:
            ValueError: The model is another one, or has another number of parameters.
        """
        if model not in CAMERA_PARAMETERS:
            raise ValueError(f"{model!r} is none of {', '.join(CAMERA_PARAMETERS)}")
        names = CAMERA_PARAMETERS[model].split()
        focals = values[: sum(name.startswith("f") for name in names)]
        if len(values) != len(names) or min(focals) <= 0:
            raise ValueError(f"{model} has {len(names)} parameters: {', '.join(names)}")
        given = dict.fromkeys(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), 0.0)
        given |= dict(zip(names, values, strict=True))
        focal = np.array([given.get("fx", given.get("f")), given.get("fy", given.get("f"))])
        k1, k2, p1, p2, k3, k4, k5, k6 = (given[name] for name in list(given)[:8])

        def look(pixels: Floats) -> Floats:
            plane = distorted = (pixels - (given["cx"], given["cy"])) / focal
            for _ in range(UNDISTORTIONS):
                square = np.sum(plane**2, axis=1, keepdims=True)
                radial = 1 + square * (k1 + square * (k2 + square * k3))
                radial /= 1 + square * (k4 + square * (k5 + square * k6))
                product = np.prod(plane, axis=1, keepdims=True)
                tangential = 2 * product * (p1, p2) + (square + 2 * plane**2) * (p2, p1)
                plane = (distorted - tangential) / radial
            return np.column_stack([plane, np.ones(len(plane))])

        focal_length = float(focal.mean()) / max(size)
        rays = Rays.fit(look, size, focal_length, bytes(32), 0)
        return replace(cls.of_focal_length(*size, focal_length), rays=rays)

    @property
    def focal_length(self) -> float:
        """Focal length as a multiple of the longer side."""
        return self.focal_pixels / max(self.width, self.height)

    def with_focal_length(self, focal_length: float) -> Camera:
        """Return the same camera with a focal length in longer sides."""
        return replace(self, focal_pixels=focal_length * max(self.width, self.height))

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same photo at another size."""
        focal_pixels = self.focal_length * max(width, height)
        return replace(self, width=width, height=height, focal_pixels=focal_pixels)

    def undistort(self, pixels: Floats) -> Floats:
        """Return the (m, 2) pixels where `project` has what the photo shows at (m, 2) pixels."""
        return pixels if self.rays is None else self.rays.undistort(pixels, self.width, self.height)

    def project(self, points: Floats) -> Floats:
        """Project (m, 3) points in the camera's axes to (m, 2) pixels."""
        plane = points[:, :2] / points[:, 2:]
        scale = self.focal_pixels * (1 + self.radial * np.sum(plane**2, axis=1))
        pixels: Floats = scale[:, None] * plane + (self.width / 2, self.height / 2)
        return pixels

    def as_poselib(self) -> dict[str, Any]:
        """Return the camera as poselib takes it."""
        params = [self.focal_pixels, self.width / 2, self.height / 2, self.radial]
        return {
            "model": "SIMPLE_RADIAL",
            "width": self.width,
            "height": self.height,
            "params": params,
        }


def focal_length_from_exif(
    width: int,
    height: int,
    focal_35mm: float | None = None,
    focal_mm: float | None = None,
    focal_plane_x_resolution: float | None = None,
    focal_plane_resolution_unit: int | None = None,
) -> float | None:
    """Return the focal length as a multiple of the longer side; None if EXIF does not say it.

    FocalLengthIn35mmFilm compares diagonals (CIPA DC-008), of which film has 43.3 mm. Otherwise
    it is FocalLength over the width of the sensor, which has `width` pixels.

    Args:
        width, height: pixels of the photo as it was taken.
        focal_35mm: FocalLengthIn35mmFilm, millimetres; 0 means unknown.
        focal_mm: FocalLength, millimetres.
        focal_plane_x_resolution: pixels for each FocalPlaneResolutionUnit.
        focal_plane_resolution_unit: 2 is an inch, 3 a centimetre.
    """
    longer = max(width, height)
    found = 0.0
    if focal_35mm:
        found = focal_35mm / FILM_DIAGONAL_MM * math.hypot(width, height) / longer
    elif focal_mm and focal_plane_x_resolution and focal_plane_resolution_unit in UNITS_MM:
        found = focal_mm * focal_plane_x_resolution / UNITS_MM[focal_plane_resolution_unit] / longer
    return found if MIN_FOCAL_LENGTH <= found <= MAX_FOCAL_LENGTH else None
