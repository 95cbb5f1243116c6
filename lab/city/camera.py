"""The pinhole camera, and which facades lie around it."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin, tan

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera with square pixels and its principal point in the middle of the photo.

    A point p (east, north, up; metres) is projected to the pixels

        (x, y) = (width / 2, height / 2) + focal * (right @ (p - c), down @ (p - c)) / depth
        depth = forward @ (p - c)

    where c is `position`, and right, down and forward are the rows of `rotation`.
    """

    x: float
    """east, metres"""
    y: float
    """north, metres"""
    yaw: float
    """degrees clockwise from north"""
    fov: float
    """horizontal field of view, degrees"""
    eye: float = 1.9
    """metres above the road"""
    width: int = 320
    height: int = 240
    pitch: float = 0.0
    """degrees upwards"""
    roll: float = 0.0
    """degrees clockwise"""

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / tan(radians(self.fov) / 2)

    @property
    def position(self) -> Floats:
        """(3,) metres: east, north, up."""
        return np.array([self.x, self.y, self.eye])

    @property
    def rotation(self) -> Floats:
        """(3, 3) from east, north and up to right, down and forward."""
        yaw, pitch, roll = radians(self.yaw), radians(self.pitch), radians(self.roll)
        right = np.array([cos(yaw), -sin(yaw), 0.0])
        forward = np.array([sin(yaw) * cos(pitch), cos(yaw) * cos(pitch), sin(pitch)])
        down = np.cross(forward, right)
        return np.stack(
            [cos(roll) * right + sin(roll) * down, cos(roll) * down - sin(roll) * right, forward]
        )

    def rays(self, x: Floats, y: Floats) -> Floats:
        """Return the (n, 3) directions of pixels in the city, one metre deep."""
        seen = np.stack([x - self.width / 2, y - self.height / 2, np.full(len(x), self.focal)])
        return np.asarray(seen.T / self.focal @ self.rotation)

    def project(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Project (n, 3) metres to x and y in pixels and depth in metres."""
        right, down, depth = self.rotation @ (points - self.position).T
        scale = self.focal / depth
        return self.width / 2 + scale * right, self.height / 2 + scale * down, depth

    def azimuths(self, count: int) -> Floats:
        """Return (count, 2) horizontal directions, from the left to the right of the view."""
        corners = self.rays(
            np.array([0.0, self.width, 0.0, self.width]),
            np.array([0.0, 0.0, self.height, self.height]),
        )
        yaw = radians(self.yaw)
        ahead = corners[:, :2] @ (sin(yaw), cos(yaw))
        aside = corners[:, :2] @ (cos(yaw), -sin(yaw))
        angles = np.arctan2(aside, ahead)
        directions = yaw + np.linspace(angles.min(), angles.max(), count)
        return np.stack([np.sin(directions), np.cos(directions)], axis=1)


@dataclass(frozen=True, slots=True)
class RayHits:
    """The nearest wall of each horizontal ray; the distance is infinite if there is none."""

    distance: Floats
    """metres"""
    wall: NDArray[np.int64]
    """index"""
    along: Floats
    """metres from the start of the wall"""


def cast_rays(
    origin: Floats, rays: Floats, starts: Floats, directions: Floats, lengths: Floats
) -> RayHits:
    """Cast horizontal rays against vertical walls, which are seen from their front only.

    Args:
        origin: (2,) metres.
        rays: (rays, 2) unit vectors.
        starts: (walls, 2) left ends of the walls as seen from the front, metres.
        directions: (walls, 2) unit vectors to the right ends.
        lengths: (walls,) metres.
    """
    across = _cross(rays[:, None], directions)
    divisor = np.where(across < -1e-9, across, np.nan)
    relative = starts - origin
    distance = _cross(relative, directions) / divisor
    along = _cross(relative, rays[:, None]) / divisor
    hit = (distance > 0) & (along >= 0) & (along <= lengths)
    distance = np.where(hit, distance, np.inf)
    wall = distance.argmin(axis=1)
    rows = np.arange(len(rays))
    return RayHits(distance[rows, wall], wall, along[rows, wall])


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
