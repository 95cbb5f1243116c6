"""A drive around a block, and queries on the same streets: photos whose camera poses are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.city.camera import Camera, Floats
from lab.city.plan import CityOptions, CityPlan, PlannedPhoto, make_plan
from lab.city.sessions import SUMMER, CaptureSession
from lab.city.streets import Quarter
from lab.city.textures import random_stream

STEP_M = 2.5
"""Between two photos of the drive"""
CORNER_M = 5.0
LANE_M = 1.6
LOOK_DEGREES = 50.0
"""to the left of the driving direction"""
DATABASE_FOV, QUERY_FOV = 72.0, (58.0, 86.0)
ACROSS_M, YAW_DEGREES = 1.5, 20.0
EYE_M = (1.55, 2.3)


@dataclass(frozen=True, slots=True)
class _Path:
    points: Floats
    along: Floats

    def at(self, metres: float) -> tuple[Floats, float]:
        """Return the position, and the heading in degrees."""
        here, before, after = (self._point(metres + step) for step in (0.0, -0.5, 0.5))
        return here, math.degrees(math.atan2(*(after - before)))

    def _point(self, metres: float) -> Floats:
        metres %= self.along[-1]
        return np.array([np.interp(metres, self.along, self.points[:, axis]) for axis in (0, 1)])


def plan_round_trip(
    seed: int, queries: Sequence[tuple[CaptureSession, int]], outside: int = 0
) -> CityPlan:
    """Plan a drive in summer around the block of a small city, and queries of other sessions.

    Args:
        queries: Sessions with their number of queries; cameras and directions vary.
        outside: Queries of another quarter, in the first of these sessions.
    """
    options = CityOptions(20, 1, 1, seed, 0, 0.0, 640, 480, train=False)
    plan = make_plan(options)
    rng = random_stream(seed, "round trip")
    drive = _around(plan.quarters["map"])
    photos = []
    for number in range(int(drive.along[-1] / STEP_M)):
        metres = number * STEP_M + rng.normal(0, 0.2)
        across, yaw, eye = rng.normal(0, 0.25), rng.normal(0, 2), rng.normal(1.9, 0.05)
        camera = _camera(drive, metres, across, yaw, DATABASE_FOV, eye, rng)
        photos.append(_photo("database", "map", camera, SUMMER, number))
    taken_in = [("map", session) for session, count in queries for _ in range(count)]
    taken_in += [("outskirts", queries[0][0])] * outside
    for number, (quarter, session) in enumerate(taken_in):
        path = _around(plan.quarters[quarter])
        metres, across = rng.uniform(0, path.along[-1]), rng.uniform(-ACROSS_M, ACROSS_M)
        yaw, fov = rng.uniform(-YAW_DEGREES, YAW_DEGREES), rng.uniform(*QUERY_FOV)
        camera = _camera(path, metres, across, yaw, fov, rng.uniform(*EYE_M), rng)
        photos.append(_photo("query", quarter, camera, session, number))
    return CityPlan(options, plan.quarters, photos)


def _around(quarter: Quarter) -> _Path:
    """Return the path around the first block, counterclockwise in the right lane."""
    nodes = [quarter.nodes[index] for index in ((1, 1), (2, 1), (2, 2), (1, 2))]
    points = []
    for number, node in enumerate(nodes):
        before, after = nodes[number - 1], nodes[(number + 1) % 4]
        (one, right), (other, other_right) = _way(before, node), _way(node, after)
        start, end = node - CORNER_M * one + right, node + CORNER_M * other + other_right
        share = np.linspace(0, 1, 12)[:, None]
        corner = (1 - share) ** 2 * start + 2 * share * (1 - share) * (node + right + other_right)
        points.append(corner + share**2 * end)
    path = np.concatenate([*points, points[0][:1]])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return _Path(path, np.concatenate([[0.0], np.cumsum(steps)]))


def _way(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Return the direction, and the offset of the lane to its right."""
    direction = (end - start) / np.linalg.norm(end - start)
    return direction, LANE_M * np.array([direction[1], -direction[0]])


def _camera(
    path: _Path,
    metres: float,
    across: float,
    yaw: float,
    fov: float,
    eye: float,
    rng: np.random.Generator,
) -> Camera:
    position, heading = path.at(metres)
    turn = math.radians(heading)
    x, y = position + across * np.array([-math.cos(turn), math.sin(turn)])
    pitch, roll = rng.normal(6, 1.5), rng.normal(0, 0.8)
    heading = (heading - LOOK_DEGREES + yaw) % 360
    return Camera(float(x), float(y), heading, fov, eye, 640, 480, pitch, roll)


def _photo(
    role: str, quarter: str, camera: Camera, session: CaptureSession, number: int
) -> PlannedPhoto:
    folder = "database" if role == "database" else "queries"
    kind = "in_map" if quarter == "map" else "out_of_map"
    name = f"{number:05d}-{session.name}.jpg"
    return PlannedPhoto(role, kind, quarter, 0, camera, session, number, folder, name)
