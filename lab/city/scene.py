"""The scene: the parallelograms of a quarter that a camera may see on the day of a session.

Everything stands at a fixed place. Vehicles are others on another day, and trees change their
leaves; the rest is the same in all sessions.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from math import cos, radians, sin

import numpy as np
from PIL import Image

from lab.city.camera import Camera, Floats, cast_rays
from lab.city.houses import PIXELS_PER_METRE, draw_house, make_house_style
from lab.city.objects import LAMP_M, PAINTS, UP, VEHICLE_SHARES, make_object_style
from lab.city.raster import SUPERSAMPLING, Canvas, Quad, Texture
from lab.city.sessions import CaptureSession
from lab.city.streets import PAVEMENT_M, Quarter, Street
from lab.city.textures import CODE_FLAT, draw_surface, painted, random_stream

FACADE_RANGE_M = 190.0
OBJECT_RANGE_M = 75.0
NEAR_PAVEMENT_M = 80.0
"""To the middle of its facade row"""
NEAREST_OBJECT_M = 2.5
"""Closer ones are left out, so that none fills the photo"""
KERB_M = 0.12
"""Height"""
TILE_M = 16.0
ROAD_TILES = 24
"""Tiles of the road around a camera, per axis"""
LINE_M = 0.14
DASH_M = 4.5
"""From dash to dash"""
KERB_CLEARANCE_M = 1.05
"""From the kerb to the centre of a parked vehicle"""
CORNER_M = 9.0
"""No parking at both ends of a street"""
HOUSES_KEPT = 400
"""Textures of about 1 MB"""

PlacedObject = tuple[Floats, list[Quad]]
"""(3,) position and parallelograms"""


class CityStyle:
    """The textures that all quarters of a city share."""

    def __init__(self, seed: int) -> None:
        rng = random_stream(seed, "ground")
        self.houses = make_house_style(seed)
        self.objects = make_object_style(seed)
        self.road = Texture(draw_surface(rng, 512, (107, 107, 110), code=CODE_FLAT))
        paving = draw_surface(
            rng, 512, (156, 153, 147), brick=(16, 16), spread=0.03, code=CODE_FLAT
        )
        self.paving = Texture(paving)
        self.kerb = Texture(Image.new("RGBA", (4, 4), painted((142, 148, 152))))
        dash = Image.new("RGBA", (64, 2), (0, 0, 0, 0))
        dash.paste((200, 204, 204, CODE_FLAT), (0, 0, 26, 2))
        self.line = Texture(dash)


class Scene:
    """Everything that stands in one quarter; textures and objects are cached."""

    def __init__(self, quarter: Quarter, style: CityStyle) -> None:
        self.quarter = quarter
        self.style = style
        self._house = lru_cache(HOUSES_KEPT)(self._draw_house)
        self._objects = lru_cache(None)(self._place_objects)
        self._vehicles = lru_cache(None)(self._place_vehicles)
        self._street_middles = np.stack(
            [street.start + street.direction * street.length / 2 for street in quarter.streets]
        )
        lengths = quarter.side_lengths[:, None]
        self._side_middles = quarter.side_starts + quarter.side_directions * lengths / 2

    def view(self, camera: Camera, session: CaptureSession) -> Canvas:
        """Draw what a camera sees on the day of a session, without its light."""
        canvas = Canvas(camera)
        seen = self.visible_houses(camera)
        for side, plot in sorted(seen, key=lambda house: seen[house]):
            canvas.draw(self._facade(side, plot, session))
        for position, quads in self._near_objects(camera, session):
            if np.linalg.norm(position[:2] - camera.position[:2]) > NEAREST_OBJECT_M:
                for quad in quads:
                    canvas.draw(quad)
        for quad in self._ground(camera, {side for side, _ in seen}):
            canvas.draw(quad)
        return canvas

    def lamps(self, camera: Camera) -> list[Floats]:
        """Return the street lamps around a camera: (3,) metres."""
        return [lamp for street in self._near_streets(camera) for lamp in self._place_lamps(street)]

    def _near_streets(self, camera: Camera) -> list[Street]:
        """Return the streets whose objects may be in view."""
        away = np.linalg.norm(self._street_middles - camera.position[:2], axis=1)
        return [self.quarter.streets[n] for n in np.flatnonzero(away < OBJECT_RANGE_M + 60.0)]

    def visible_houses(self, camera: Camera) -> dict[tuple[int, int], float]:
        """Return the metres to each house that no others hide, by its facade row and plot."""
        quarter, here = self.quarter, camera.position[:2]
        sides = np.flatnonzero(np.linalg.norm(self._side_middles - here, axis=1) < FACADE_RANGE_M)
        hits = cast_rays(
            here,
            camera.azimuths(SUPERSAMPLING * camera.width),
            quarter.side_starts[sides],
            quarter.side_directions[sides],
            quarter.side_lengths[sides],
        )
        nearest: dict[tuple[int, int], float] = {}
        for number in np.unique(hits.wall):
            side, cuts = int(sides[number]), quarter.sides[sides[number]].cuts
            of_wall = np.flatnonzero((hits.wall == number) & np.isfinite(hits.distance))
            plots = np.searchsorted(cuts[1:-1], hits.along[of_wall], side="right")
            for plot in np.unique(plots).tolist():
                nearest[side, plot] = float(hits.distance[of_wall[plots == plot]].min())
        return nearest

    def _facade(self, side: int, plot: int, session: CaptureSession) -> Quad:
        row, texture = self.quarter.sides[side], self._house(side, plot)
        left, right = (_ground(row.start + row.direction * row.cuts[n]) for n in (plot, plot + 1))
        top = UP * (texture.heights[0] / PIXELS_PER_METRE)
        east, north = row.direction
        azimuth = radians(session.sun_azimuth)
        sun = max(0.0, north * sin(azimuth) - east * cos(azimuth))
        return Quad(left + top, right - left, -top, texture, sun)

    def _draw_house(self, side: int, plot: int) -> Texture:
        row = self.quarter.sides[side]
        rng = random_stream(self.quarter.seed, self.quarter.name, "house", side, plot)
        width = float(row.cuts[plot + 1] - row.cuts[plot])
        return Texture(draw_house(rng, width, row.shopping, row.floors, self.style.houses))

    def _ground(self, camera: Camera, seen: set[int]) -> Iterator[Quad]:
        """Yield pavements with their kerbs, the lines of streets, and the road.

        `seen`: the facade rows in view. Pavements of others may be, too, where they are near.
        """
        style, kerb = self.style, UP * KERB_M
        away = np.linalg.norm(self._side_middles - camera.position[:2], axis=1)
        for side in seen.union(np.flatnonzero(away < NEAR_PAVEMENT_M).tolist()):
            row = self.quarter.sides[side]
            outwards = np.array([row.direction[1], -row.direction[0]])
            if (camera.position[:2] - row.start) @ outwards < 0:
                continue
            wide = _ground(outwards * PAVEMENT_M)
            long = _ground(row.direction * (row.length + 2 * PAVEMENT_M))
            edge = _ground(row.start - row.direction * PAVEMENT_M) + wide + kerb
            tiles = (row.length + 2 * PAVEMENT_M) / TILE_M, PAVEMENT_M / TILE_M
            yield Quad(edge, long, -wide, style.paving, 0.6, tiles)
            yield Quad(edge, long, -kerb, style.kerb)
        for street in self._near_streets(camera):
            wide = _ground(street.left * LINE_M)
            corner = _ground(street.start) + wide / 2 + UP * 0.01
            tiles = street.length / DASH_M, 1.0
            yield Quad(
                corner, _ground(street.direction * street.length), -wide, style.line, 0.6, tiles
            )
        size = TILE_M * ROAD_TILES
        corner = np.floor(camera.position[:2] / TILE_M) * TILE_M + (-size / 2, size / 2)
        across, down = np.array([size, 0.0, 0.0]), np.array([0.0, -size, 0.0])
        yield Quad(_ground(corner), across, down, style.road, 0.6, (ROAD_TILES, ROAD_TILES))

    def _near_objects(self, camera: Camera, session: CaptureSession) -> Iterator[PlacedObject]:
        for street in self._near_streets(camera):
            yield from _in_view(camera, self._objects(street.number, session.foliage))
            yield from _in_view(camera, self._vehicles(street.number, session.name))

    def _place_objects(self, number: int, foliage: str) -> list[PlacedObject]:
        """Place trees and cabinets on the pavements of a street, and its lamps."""
        street, style = self.quarter.streets[number], self.style.objects
        rng = random_stream(self.quarter.seed, self.quarter.name, "standing", number)
        heading = _ground(street.direction)
        found = [
            (lamp, style.lamp.crossed(lamp - UP * LAMP_M, heading))
            for lamp in self._place_lamps(street)
        ]
        for side in (-1.0, 1.0):
            along = 14.0 + rng.uniform(0, max(street.trees, 1.0))
            while street.trees and along < street.length - 14.0:
                tree = style.trees[foliage][int(rng.integers(len(style.trees[foliage])))]
                foot = _on_pavement(street, along, side, 0.7)
                if rng.uniform() < 0.85:
                    found.append((foot, tree.crossed(foot, heading)))
                along += street.trees * rng.uniform(0.8, 1.25)
            for along in rng.uniform(10, street.length - 10, rng.poisson(2.5)):
                cabinet = style.cabinets[int(rng.integers(len(style.cabinets)))]
                foot = _on_pavement(street, along, side, 0.45)
                found.append((foot, cabinet.crossed(foot, heading)))
        return found

    def _place_lamps(self, street: Street) -> list[Floats]:
        rng = random_stream(self.quarter.seed, self.quarter.name, "lamps", street.number)
        found = []
        for side in (-1.0, 1.0):
            along = 10.0 + rng.uniform(0, 22)
            while along < street.length - 8.0:
                found.append(_on_pavement(street, along, side, 0.35) + UP * LAMP_M)
                along += rng.uniform(22, 30)
        return found

    def _place_vehicles(self, number: int, day: str) -> list[PlacedObject]:
        """Place the vehicles of one day in a street: parked at both kerbs, and a few driving."""
        street = self.quarter.streets[number]
        rng = random_stream(self.quarter.seed, self.quarter.name, "vehicles", number, day)
        lane = street.half_width - PAVEMENT_M - KERB_CLEARANCE_M
        spots = [
            (rng.uniform(10, street.length - 10), rng.choice([-1.0, 1.0]), 0.4 * lane)
            for _ in range(rng.poisson(0.7))
        ]
        for side in (-1.0, 1.0):
            along = CORNER_M + rng.uniform(0, 6) + street.half_width
            while along < street.length - CORNER_M - street.half_width:
                if rng.uniform() < street.parking:
                    spots.append((along, side, lane))
                along += 6.2 + rng.uniform(0, 1.5)
        found = []
        for along, side, away in spots:
            shape = int(rng.choice(len(VEHICLE_SHARES), p=VEHICLE_SHARES))
            vehicle = self.style.objects.vehicles[shape][int(rng.integers(len(PAINTS)))]
            middle = street.start + street.direction * along + street.left * side * away
            heading = _ground(street.direction * -side)
            found.append((_ground(middle), vehicle.quads(_ground(middle), heading)))
        return found


def _ground(point: Floats) -> Floats:
    return np.append(point, 0.0)


def _on_pavement(street: Street, along: float, side: float, from_kerb: float) -> Floats:
    away = street.half_width - PAVEMENT_M + from_kerb
    return (
        _ground(street.start + street.direction * along + street.left * side * away) + UP * KERB_M
    )


def _in_view(camera: Camera, placed: list[PlacedObject]) -> list[PlacedObject]:
    """Return the objects in front of the camera, within range and its field of view."""
    if not placed:
        return []
    away = np.stack([position for position, _ in placed]) - camera.position
    right, _, depth = camera.rotation @ away.T
    reach = depth * (camera.width / 2 / camera.focal) + 4.0  # half of a vehicle, with a margin
    seen = (depth > 0) & (depth < OBJECT_RANGE_M) & (np.abs(right) < reach)
    return [placed[index] for index in np.flatnonzero(seen)]
