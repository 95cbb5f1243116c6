"""What of the street's things a camera sees: flat pictures, each with its columns and depths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.datasets.city.camera import Camera, Floats, cast_rays
from shared.datasets.city.canvas import SUPERSAMPLING
from shared.datasets.city.catalogue import Catalogue
from shared.datasets.city.scene import (
    BLADE_REACH_M,
    StreetObject,
    Vehicle,
    VehiclePanel,
    place_street_objects,
    place_vehicles,
    shop_blades,
    vehicle_panels,
)
from shared.datasets.city.sessions import CaptureSession
from shared.datasets.city.street_things import Sprite
from shared.datasets.city.streets import Metres, Quarter

OBJECT_RANGE_M = 75.0
BLADE_RANGE_M = 45.0
NEAREST_M = 1.3
"""what is nearer to the lens is left out"""
LARGEST_REACH_M = 4.0
"""half of the longest vehicle, and some more"""


@dataclass(slots=True)
class VisibleSprite:
    """A flat picture and the canvas columns that it fills."""

    depth: float
    """of its middle, metres: farther ones are painted first"""
    first: int
    """column"""
    depths: Floats
    alongs: Floats
    """metres from the picture's left edge, per column"""
    picture: Sprite
    key: tuple[str, int]


class VisibleObjects:
    """Looks around in one quarter; remembers what it has met."""

    def __init__(self, quarter: Quarter, catalogue: Catalogue) -> None:
        self.quarter = quarter
        self.catalogue = catalogue
        self._standing: dict[int, list[StreetObject]] = {}
        self._vehicles: dict[tuple[int, str], list[Vehicle]] = {}
        self._blades: dict[int, list[tuple[Metres, Metres, int]]] = {}
        self._middles = np.stack(
            [street.start + street.direction * street.length / 2 for street in quarter.streets]
        )

    def items(
        self, camera: Camera, session: CaptureSession, sides: NDArray[np.int64], slopes: Floats
    ) -> Iterator[VisibleSprite]:
        """The pictures in sight on the session's day, before anything hides them; in no order.

        `sides` are the facade rows whose shops' boards are looked at, `slopes` the columns' rays.
        """
        away = np.hypot(*(self._middles - camera.position).T)
        for number in np.flatnonzero(away < OBJECT_RANGE_M + 60.0).tolist():
            things = self._standing_at(number)
            for i in _is_visible(camera, [thing.position for thing in things], OBJECT_RANGE_M):
                item = self._billboard(camera, session, things[i])
                if item:
                    yield item
            vehicles = self._vehicles_at(number, session.name)
            for i in _is_visible(camera, [v.position for v in vehicles], OBJECT_RANGE_M):
                for panel in vehicle_panels(vehicles[i], self.catalogue, camera.position):
                    item = _panel_item(camera, panel, slopes)
                    if item:
                        yield item
        for side in sides.tolist():
            blades = self._blades_at(side)
            for i in _is_visible(camera, [foot for foot, _, _ in blades], BLADE_RANGE_M):
                foot, outwards, index = blades[i]
                away = camera.position - foot
                # Only one of its two faces is turned towards the camera.
                from_right = away[0] * outwards[1] - away[1] * outwards[0] > 0
                start = foot if from_right else foot + outwards * BLADE_REACH_M
                direction = outwards if from_right else -outwards
                panel = VehiclePanel(
                    start, direction, self.catalogue.blades[index], ("blade", index)
                )
                item = _panel_item(camera, panel, slopes)
                if item:
                    yield item

    def _standing_at(self, number: int) -> list[StreetObject]:
        if number not in self._standing:
            street = self.quarter.streets[number]
            self._standing[number] = place_street_objects(self.quarter, street, self.catalogue)
        return self._standing[number]

    def _vehicles_at(self, number: int, day: str) -> list[Vehicle]:
        key = (number, day)
        if key not in self._vehicles:
            street = self.quarter.streets[number]
            self._vehicles[key] = place_vehicles(self.quarter, street, day)
        return self._vehicles[key]

    def _blades_at(self, side: int) -> list[tuple[Metres, Metres, int]]:
        if side not in self._blades:
            self._blades[side] = shop_blades(self.quarter, side, self.catalogue)
        return self._blades[side]

    def _billboard(
        self, camera: Camera, session: CaptureSession, thing: StreetObject
    ) -> VisibleSprite | None:
        away = thing.position - camera.position
        depth = float(away @ camera.forward)
        if not NEAREST_M < depth < OBJECT_RANGE_M:
            return None
        if thing.kind == "tree":
            picture = self.catalogue.trees[session.foliage][thing.index]
            key = (f"tree {session.foliage}", thing.index)
        else:
            picture = getattr(self.catalogue, thing.kind)[thing.index]
            key = (thing.kind, thing.index)
        left = float(away @ camera.right) - picture.width / 2
        scale = SUPERSAMPLING * camera.focal / depth
        middle = SUPERSAMPLING * camera.width / 2
        first = max(0, int(np.ceil(middle + left * scale - 0.5)))
        last = min(
            SUPERSAMPLING * camera.width, int(middle + (left + picture.width) * scale - 0.5) + 1
        )
        if last <= first:
            return None
        alongs = (np.arange(first, last) + 0.5 - middle) / scale - left
        return VisibleSprite(
            depth, first, np.full(last - first, depth), np.asarray(alongs, np.float64), picture, key
        )


def _is_visible(camera: Camera, positions: list[Metres], within: float) -> list[int]:
    """Which of the positions lie before the camera, not far off, and about in its view."""
    if not positions:
        return []
    away = np.stack(positions) - camera.position
    depth, lateral = away @ camera.forward, away @ camera.right
    reach = depth * (camera.width / 2 / camera.focal) + LARGEST_REACH_M
    seen = (depth > NEAREST_M) & (depth < within) & (np.abs(lateral) < reach)
    return [int(i) for i in np.flatnonzero(seen)]


def _panel_item(camera: Camera, panel: VehiclePanel, slopes: Floats) -> VisibleSprite | None:
    """The panel's columns; None when it is out of sight."""
    width = panel.picture.width
    ends = np.stack([panel.start, panel.start + panel.direction * width]) - camera.position
    depths, laterals = ends @ camera.forward, ends @ camera.right
    if depths.min() < NEAREST_M or depths.max() > OBJECT_RANGE_M:
        return None
    pixels = SUPERSAMPLING * (camera.width / 2 + camera.focal * laterals / depths)
    first, last = max(0, int(pixels[0])), min(SUPERSAMPLING * camera.width, int(pixels[1]) + 1)
    if last <= first:
        return None
    hits = cast_rays(
        camera,
        slopes[first:last],
        panel.start[None],
        panel.direction[None],
        np.array([width]),
    )
    seen = np.flatnonzero(np.isfinite(hits.depth))
    if not len(seen):
        return None
    run = slice(int(seen[0]), int(seen[-1]) + 1)
    alongs = width - hits.along[run] if panel.mirrored else hits.along[run]
    return VisibleSprite(
        float(depths.mean()), first + run.start, hits.depth[run], alongs, panel.picture, panel.key
    )
