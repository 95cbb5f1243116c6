"""Cameras: the model of COLMAP's SIMPLE_RADIAL, and focal lengths from EXIF."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
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
"""in longer sides, where a guess is needed: 26 mm of film"""


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


@dataclass(frozen=True, slots=True)
class Camera:
    """COLMAP's SIMPLE_RADIAL with the principal point in the middle of the photo.

    A point (x, y, z) in the camera's axes is projected to the pixels

        (width, height) / 2 + focal_pixels * (1 + radial * r^2) * (x, y) / z

    where r^2 = (x^2 + y^2) / z^2.
    """

    width: int
    height: int
    focal_pixels: float
    radial: float = 0.0

    @classmethod
    def of_focal_length(cls, width: int, height: int, focal_length: float) -> Camera:
        """Return a camera without distortion; `focal_length` is a multiple of the longer side."""
        return cls(width, height, focal_length * max(width, height))

    @property
    def focal_length(self) -> float:
        """Focal length as a multiple of the longer side."""
        return self.focal_pixels / max(self.width, self.height)

    def with_focal_length(self, focal_length: float) -> Camera:
        """Return the same camera with a focal length in longer sides."""
        return replace(self, focal_pixels=focal_length * max(self.width, self.height))

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same photo at another size."""
        return Camera(width, height, self.focal_length * max(width, height), self.radial)

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
