"""Scene: objects and vehicles in the streets, and the sprites of them that a camera sees.

Trees, lamps, signs and boxes are the same in all sessions; vehicles differ between sessions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from lab.city.camera import SUPERSAMPLING, Camera, Floats, cast_rays
from lab.city.catalogue import VEHICLE_PAINTS, Catalogue
from lab.city.sessions import CaptureSession
from lab.city.street_objects import VEHICLE_SHARES, Sprite
from lab.city.streets import PAVEMENT_M, Metres, Quarter
from lab.city.textures import random_stream

KERB_CLEARANCE_M = 1.05
"""From the kerb to the centre of a parked vehicle"""
CORNER_M = 9.0
"""No-parking zone at both ends of a street"""
BLADE_REACH_M = 0.85


@dataclass(frozen=True, slots=True)
class _StreetObject:
    """A permanent object, drawn as a billboard: the same sprite from every side."""

    position: Metres
    kind: str
    """`tree`, or a field of the catalogue: lamps, posts, boxes"""
    index: int


@dataclass(frozen=True, slots=True)
class _Vehicle:
    """A vehicle: a box whose sides and ends are sprites."""

    position: Metres
    """Of its centre"""
    heading: Metres
    """Unit vector towards its front"""
    index: int


@dataclass(frozen=True, slots=True)
class _VehiclePanel:
    """A vertical sprite fixed in the city; its direction runs left to right as seen."""

    start: Metres
    direction: Metres
    picture: Sprite
    key: tuple[str, int]
    mirrored: bool = False


def _place_street_objects(
    quarter: Quarter, catalogue: Catalogue, number: int
) -> list[_StreetObject]:
    """Place the permanent objects on the pavements of a street."""
    street = quarter.streets[number]
    rng = random_stream(quarter.seed, quarter.name, "standing", number)
    objects = []
    kerb = street.half_width - PAVEMENT_M
    for side in (-1.0, 1.0):

        def on_pavement(along: float, out: float, side: float = side) -> Metres:
            middle = street.start + street.direction * along
            return np.asarray(middle + street.left * side * (kerb + out))

        if street.trees:
            along = 14.0 + rng.uniform(0, street.trees)
            while along < street.length - 14.0:
                index = int(rng.integers(len(catalogue.trees["summer"])))
                if rng.uniform() < 0.85:
                    objects.append(_StreetObject(on_pavement(along, 0.7), "tree", index))
                along += street.trees * rng.uniform(0.8, 1.25)
        along = 10.0 + rng.uniform(0, 22)
        while along < street.length - 8.0:
            objects.append(_StreetObject(on_pavement(along, 0.35), "lamps", 0))
            along += rng.uniform(22, 30)
        for kind, count in (("posts", rng.poisson(1.6)), ("boxes", rng.poisson(1.4))):
            for _ in range(int(count)):
                along = rng.uniform(10, max(11.0, street.length - 10))
                index = int(rng.integers(len(getattr(catalogue, kind))))
                objects.append(
                    _StreetObject(on_pavement(along, rng.uniform(0.3, 0.6)), kind, index)
                )
    return objects


def _place_vehicles(quarter: Quarter, number: int, day: str) -> list[_Vehicle]:
    """Place the vehicles of one day in a street: parked at both kerbs, and a few driving."""
    street = quarter.streets[number]
    rng = random_stream(quarter.seed, quarter.name, "vehicles", number, day)
    vehicles = []
    lane = street.half_width - PAVEMENT_M - KERB_CLEARANCE_M
    for side in (-1.0, 1.0):
        along = CORNER_M + rng.uniform(0, 6) + street.half_width
        while along < street.length - CORNER_M - street.half_width:
            if rng.uniform() < street.parking:
                index = _choose_vehicle(rng)
                middle = street.start + street.direction * along
                vehicles.append(
                    _Vehicle(middle + street.left * side * lane, street.direction * -side, index)
                )
            along += 6.2 + rng.uniform(0, 1.5)
    for _ in range(int(rng.poisson(0.7))):
        side = float(rng.choice([-1.0, 1.0]))
        middle = street.start + street.direction * rng.uniform(10, street.length - 10)
        vehicles.append(
            _Vehicle(
                middle + street.left * side * lane * 0.4,
                street.direction * -side,
                _choose_vehicle(rng),
            )
        )
    return vehicles


def _choose_vehicle(rng: np.random.Generator) -> int:
    """Return a random index of the catalogue, which is ordered by shape, then paint."""
    shape = int(rng.choice(len(VEHICLE_SHARES), p=VEHICLE_SHARES))
    return shape * len(VEHICLE_PAINTS) + int(rng.integers(len(VEHICLE_PAINTS)))


def _vehicle_panels(
    vehicle: _Vehicle, catalogue: Catalogue, seen_from: Metres
) -> list[_VehiclePanel]:
    """Return the panels of a vehicle (side, end, windscreen) that are visible from a point."""
    side = catalogue.vehicle_sides[vehicle.index]
    front = catalogue.vehicle_fronts[vehicle.index]
    ahead = vehicle.heading
    left = np.array([-ahead[1], ahead[0]])
    away = seen_from - vehicle.position
    half_length, half_width = side.width / 2, front.width / 2
    panels = []
    if away @ left > half_width:  # seen from the left, its front is on the left
        start = vehicle.position + left * half_width + ahead * half_length
        panels.append(_VehiclePanel(start, -ahead, side, ("side", vehicle.index)))
    elif away @ left < -half_width:
        start = vehicle.position - left * half_width - ahead * half_length
        panels.append(_VehiclePanel(start, ahead, side, ("side", vehicle.index), mirrored=True))
    screen = catalogue.vehicle_screens[vehicle.index]
    to_front, to_back = (half_length - metres for metres in catalogue.cabins[vehicle.index])
    if away @ ahead > half_length:
        start = vehicle.position + ahead * half_length - left * half_width
        panels.append(_VehiclePanel(start, left, front, ("front", vehicle.index)))
        start = vehicle.position + ahead * to_front - left * half_width
        panels.append(_VehiclePanel(start, left, screen, ("screen", vehicle.index)))
    elif away @ ahead < -half_length:
        start = vehicle.position - ahead * half_length + left * half_width
        rear = catalogue.vehicle_rears[vehicle.index]
        panels.append(_VehiclePanel(start, -left, rear, ("rear", vehicle.index)))
        start = vehicle.position + ahead * to_back + left * half_width
        panels.append(_VehiclePanel(start, -left, screen, ("screen", vehicle.index)))
    return panels


def _shop_blades(
    quarter: Quarter, catalogue: Catalogue, side: int
) -> list[tuple[Metres, Metres, int]]:
    """Return the projecting shop signs of a facade row: foot, outward direction, index."""
    row = quarter.sides[side]
    outwards = np.array([row.direction[1], -row.direction[0]])
    blades = []
    for plot in range(len(row.cuts) - 1):
        house = quarter.house(side, plot)
        for bay, shop in enumerate(house.shops):
            if shop >= 0 and shop % 3 == 0 and bay != house.door_bay:
                along = row.cuts[plot] + (bay + 0.04) * house.width / house.bays
                foot = row.start + row.direction * along
                blades.append((foot, outwards, shop % len(catalogue.blades)))
    return blades


OBJECT_RANGE_M = 75.0
BLADE_RANGE_M = 45.0
NEAREST_M = 1.3
"""Closer objects are not rendered"""
LARGEST_REACH_M = 4.0
"""Half of the longest vehicle, with a margin"""


@dataclass(slots=True)
class VisibleSprite:
    """A sprite and the canvas columns that it covers."""

    depth: float
    """Of its centre, metres; farther sprites are painted first"""
    first: int
    """First canvas column"""
    depths: Floats
    alongs: Floats
    """Metres from the sprite's left edge, per column"""
    picture: Sprite
    key: tuple[str, int]


class VisibleObjects:
    """Finds the sprites in view of a camera in one quarter; caches street objects."""

    def __init__(self, quarter: Quarter, catalogue: Catalogue) -> None:
        self.quarter = quarter
        self.catalogue = catalogue
        self._objects_at = cache(partial(_place_street_objects, quarter, catalogue))
        self._vehicles_at = cache(partial(_place_vehicles, quarter))
        self._blades_at = cache(partial(_shop_blades, quarter, catalogue))
        self._middles = np.stack(
            [street.start + street.direction * street.length / 2 for street in quarter.streets]
        )

    def items(
        self, camera: Camera, session: CaptureSession, sides: NDArray[np.int64], slopes: Floats
    ) -> Iterator[VisibleSprite]:
        """Yield the sprites in view on the session's day, unordered, before occlusion.

        `sides`: the facade rows whose shop signs are included; `slopes`: the columns' rays.
        """
        away = np.hypot(*(self._middles - camera.position).T)
        for number in np.flatnonzero(away < OBJECT_RANGE_M + 60.0).tolist():
            objects = self._objects_at(number)
            for i in _is_visible(camera, [item.position for item in objects], OBJECT_RANGE_M):
                item = self._billboard(camera, session, objects[i])
                if item:
                    yield item
            vehicles = self._vehicles_at(number, session.name)
            for i in _is_visible(camera, [v.position for v in vehicles], OBJECT_RANGE_M):
                for panel in _vehicle_panels(vehicles[i], self.catalogue, camera.position):
                    item = _panel_item(camera, panel, slopes)
                    if item:
                        yield item
        for side in sides.tolist():
            blades = self._blades_at(side)
            for i in _is_visible(camera, [foot for foot, _, _ in blades], BLADE_RANGE_M):
                foot, outwards, index = blades[i]
                away = camera.position - foot
                # Only one of its two faces is visible.
                from_right = away[0] * outwards[1] - away[1] * outwards[0] > 0
                start = foot if from_right else foot + outwards * BLADE_REACH_M
                direction = outwards if from_right else -outwards
                panel = _VehiclePanel(
                    start, direction, self.catalogue.blades[index], ("blade", index)
                )
                item = _panel_item(camera, panel, slopes)
                if item:
                    yield item

    def _billboard(
        self, camera: Camera, session: CaptureSession, street_object: _StreetObject
    ) -> VisibleSprite | None:
        away = street_object.position - camera.position
        depth = float(away @ camera.forward)
        if not NEAREST_M < depth < OBJECT_RANGE_M:
            return None
        if street_object.kind == "tree":
            picture = self.catalogue.trees[session.foliage][street_object.index]
            key = (f"tree {session.foliage}", street_object.index)
        else:
            picture = getattr(self.catalogue, street_object.kind)[street_object.index]
            key = (street_object.kind, street_object.index)
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
    """Return the indices of positions in front of the camera, within range and field of view."""
    if not positions:
        return []
    away = np.stack(positions) - camera.position
    depth, lateral = away @ camera.forward, away @ camera.right
    reach = depth * (camera.width / 2 / camera.focal) + LARGEST_REACH_M
    seen = (depth > NEAREST_M) & (depth < within) & (np.abs(lateral) < reach)
    return [int(i) for i in np.flatnonzero(seen)]


def _panel_item(camera: Camera, panel: _VehiclePanel, slopes: Floats) -> VisibleSprite | None:
    """Project a panel to canvas columns; None if it is not visible."""
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
