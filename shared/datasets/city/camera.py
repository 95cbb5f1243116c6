"""A pinhole camera that stands upright in the street, and its rays against vertical planes.

A point at `depth` metres along the optical axis, `lateral` metres to its right and `z` metres above
the ground is seen at

    x = width / 2 + f * lateral / depth            y = horizon + f * (eye - z) / depth

with f = width / 2 / tan(fov / 2). A camera that rolls by r adds tan(r) * (x - width / 2) to y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """Metres, degrees and pixels."""

    x: float
    """east"""
    y: float
    """north"""
    yaw: float
    """degrees clockwise from north"""
    fov: float
    """horizontal field of view, degrees"""
    eye: float = 1.9
    """height above the ground"""
    width: int = 320
    height: int = 240
    horizon: float = 0.60
    """its row, as a share of the height"""
    roll: float = 0.0
    """degrees"""

    @property
    def focal(self) -> float:
        """pixels"""
        return self.width / 2 / math.tan(math.radians(self.fov) / 2)

    @property
    def forward(self) -> Floats:
        yaw = math.radians(self.yaw)
        return np.array([math.sin(yaw), math.cos(yaw)])

    @property
    def right(self) -> Floats:
        yaw = math.radians(self.yaw)
        return np.array([math.cos(yaw), -math.sin(yaw)])

    @property
    def position(self) -> Floats:
        return np.array([self.x, self.y])

    def slopes(self, supersampling: int) -> Floats:
        """(columns,) lateral metres per metre of depth, at the middle of each column."""
        columns = (np.arange(self.width * supersampling) + 0.5) / supersampling
        return (columns - self.width / 2) / self.focal

    def horizons(self, supersampling: int) -> Floats:
        """(columns,) the row of the horizon in each column, in whole pixels."""
        lean = math.tan(math.radians(self.roll)) * self.focal
        return self.horizon * self.height + lean * self.slopes(supersampling)

    def project(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """(n, 3) metres (east, north, up) -> x and y in pixels, depth in metres."""
        away = points[:, :2] - self.position
        depth = away @ self.forward
        x = self.width / 2 + self.focal * (away @ self.right) / depth
        lean = math.tan(math.radians(self.roll)) * (x - self.width / 2)
        y = self.horizon * self.height + self.focal * (self.eye - points[:, 2]) / depth + lean
        return x, y, depth


@dataclass(frozen=True, slots=True)
class RayHits:
    """For each column the nearest plane: depth is infinite where there is none."""

    depth: Floats
    plane: NDArray[np.int64]
    """index into the planes that were cast against"""
    along: Floats
    """metres from the plane's start"""
    facing: Floats
    """metres towards the plane's normal per metre of depth"""


def cast_rays(
    camera: Camera, slopes: Floats, starts: Floats, directions: Floats, lengths: Floats
) -> RayHits:
    """Rays of the given slopes against vertical planes that are seen from their right side.

    starts and directions are (planes, 2), lengths (planes,). A plane that runs left to right as
    the camera sees it is seen; from behind it is not there.
    """
    rays = camera.forward + slopes[:, None] * camera.right  # (columns, 2)
    away = starts - camera.position
    across = rays[:, :1] * directions[:, 1] - rays[:, 1:] * directions[:, 0]  # (columns, planes)
    # The normal to the right of the direction is (d_y, -d_x): its product with the ray is `across`.
    seen = across < -1e-9
    safe = np.where(seen, across, -1.0)
    depth = (away[:, 0] * directions[:, 1] - away[:, 1] * directions[:, 0]) / safe
    along = (away[:, 0] * rays[:, 1:] - away[:, 1] * rays[:, :1]) / safe
    depth = np.where(seen & (depth > 0.3) & (along >= 0) & (along <= lengths), depth, np.inf)
    plane = depth.argmin(axis=1)
    rows = np.arange(len(slopes))
    return RayHits(
        depth=depth[rows, plane],
        plane=plane,
        along=np.clip(along[rows, plane], 0, lengths[plane]),
        facing=-across[rows, plane],
    )
