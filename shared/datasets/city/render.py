"""One photo's scene: rays against facade rows, the ground below, things in front, by depth.

Everything is drawn on a canvas twice as fine as the photo, column by column (the first axis is x):
a vertical plane is linear in a column, so that one multiply and one gather fill all of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from shared.datasets.city.camera import Camera, Floats, Hits, cast
from shared.datasets.city.catalogue import Catalogue
from shared.datasets.city.facade import draw_house
from shared.datasets.city.ground import TILE_M, TILE_PIXELS, draw_asphalt, draw_paving
from shared.datasets.city.scene import (
    BLADE_REACH_M,
    Panel,
    Thing,
    Vehicle,
    passing_vehicles,
    shop_blades,
    standing_things,
    vehicle_panels,
)
from shared.datasets.city.sessions import Session
from shared.datasets.city.street_things import Picture
from shared.datasets.city.streets import PAVEMENT_M, Metres, Quarter
from shared.datasets.city.texture_memory import LEVELS, Texture, TextureMemory
from shared.datasets.city.walls import PIXELS_PER_METRE

FINE = 2
"""canvas pixels per photo pixel, each way"""
FACADES_WITHIN_M = 190.0
THINGS_WITHIN_M = 75.0
BLADES_WITHIN_M = 45.0
NEAREST_M = 1.3
"""what is nearer to the lens is left out"""
LARGEST_REACH_M = 4.0
"""half of the longest vehicle, and some more"""
KERB_M = 0.16

Packed = NDArray[np.uint32]
WHITE_LINE = np.uint32(0x1EC8CCCC)
KERB_STONE = np.uint32(0x1E8E9498)


@dataclass(slots=True)
class View:
    """What the lens sees before any light falls on it; (x, y) arrays."""

    canvas: Packed
    """(FINE * width, FINE * height) colours and codes, 0 where only sky is"""
    depth: NDArray[np.float32]
    """(width, height) metres, infinite for the sky"""
    sun: NDArray[np.float32]
    """(width, height) share of the sun's light that arrives"""
    lamp: NDArray[np.float32]
    """(width,) share of the street lamps' light, by night"""


@dataclass(slots=True)
class _Item:
    """A flat picture with its columns, farthest first when sorted."""

    depth: float
    first: int
    depths: Floats
    alongs: Floats
    """metres from the picture's left edge, per column"""
    picture: Picture
    key: tuple[str, int]


class Painter:
    """Paints views of one quarter; keeps the textures and the standing things it has met."""

    def __init__(self, quarter: Quarter, catalogue: Catalogue, memory: TextureMemory) -> None:
        self.quarter = quarter
        self.catalogue = catalogue
        self.memory = memory
        self._standing: dict[int, list[Thing]] = {}
        self._vehicles: dict[tuple[int, str], list[Vehicle]] = {}
        self._blades: dict[int, list[tuple[Metres, Metres, int]]] = {}
        self._middles = np.stack(
            [street.start + street.direction * street.length / 2 for street in quarter.streets]
        )
        self._side_middles = (
            quarter.side_starts + quarter.side_directions * quarter.side_lengths[:, None] / 2
        )

    def view(self, camera: Camera, session: Session) -> View:
        """What the camera sees on the session's day."""
        width, height = camera.width, camera.height
        view = View(
            canvas=np.zeros((width * FINE, height * FINE), np.uint32),
            depth=np.full((width, height), np.inf, np.float32),
            sun=np.ones((width, height), np.float32),
            lamp=np.zeros(width, np.float32),
        )
        near = np.hypot(*(self._side_middles - camera.position).T)
        sides = np.flatnonzero(near < FACADES_WITHIN_M)
        slopes = camera.slopes(FINE)
        hits = cast(
            camera,
            slopes,
            self.quarter.side_starts[sides],
            self.quarter.side_directions[sides],
            self.quarter.side_lengths[sides],
        )
        self._paint_facades(view, camera, session, hits, sides)
        self._paint_ground(view, camera, hits, sides)
        for item in sorted(
            self._items(camera, session, sides[near[sides] < THINGS_WITHIN_M], slopes),
            key=lambda item: -item.depth,
        ):
            self._paint_item(view, camera, item, hits.depth)
        return view

    def _paint_facades(
        self, view: View, camera: Camera, session: Session, hits: Hits, sides: NDArray[np.int64]
    ) -> None:
        columns = np.flatnonzero(np.isfinite(hits.depth))
        if not len(columns):
            return
        depth, along = hits.depth[columns], hits.along[columns]
        side = sides[hits.plane[columns]]
        plot = np.empty(len(columns), np.int64)
        for number in np.unique(side):
            here = side == number
            cuts = self.quarter.sides[number].cuts
            found = np.searchsorted(cuts, along[here], side="right") - 1
            plot[here] = np.clip(found, 0, len(cuts) - 2)
        level = _level(PIXELS_PER_METRE, depth, camera)
        offset = np.empty(len(columns), np.int64)
        rows = np.empty(len(columns), np.int64)
        top = np.empty(len(columns))
        houses = sorted(set(zip(side.tolist(), plot.tolist(), strict=True)))
        self.memory.make_room(
            {self._key(*house): self.quarter.house(*house).pixels for house in houses}
        )
        for number, lot in houses:
            here = np.flatnonzero((side == number) & (plot == lot))
            house = self.quarter.house(number, lot)
            texture = self.memory.get(
                self._key(number, lot), partial(draw_house, house, self.catalogue), rim=False
            )
            at = level[here]
            scale = PIXELS_PER_METRE / 2.0**at
            across = (along[here] - self.quarter.sides[number].cuts[lot]) * scale
            column = np.clip(across.astype(np.int64), 0, texture.widths[at] - 1)
            offset[here] = texture.offsets[at] + column * texture.heights[at]
            rows[here] = texture.heights[at]
            top[here] = house.top
        bottom = _row_of(camera, 0.0, depth, columns)
        last = min(view.canvas.shape[1], int(bottom.max()) + 1)
        scale = PIXELS_PER_METRE / 2.0**level
        block = self._gather(camera, columns, depth, top, scale, offset, rows, 0, last)
        block *= block >= 1 << 24
        view.canvas[columns, :last] = block
        coarse = np.flatnonzero(columns % FINE == 0)
        xs = columns[coarse] // FINE
        solid = block[coarse, ::FINE] > 0
        region = view.depth[xs, : solid.shape[1]]
        view.depth[xs, : solid.shape[1]] = np.where(solid, depth[coarse, None], region)
        view.sun[xs] = self._sunlit(session, side[coarse])[:, None]
        wave = 0.5 + 0.5 * np.cos(along[coarse] * (2 * np.pi / 25.0))
        view.lamp[xs] = wave * np.exp(-depth[coarse] / 60.0)

    def _key(self, side: int, plot: int) -> tuple[str, int, int]:
        return (self.quarter.name, side, plot)

    def _sunlit(self, session: Session, sides: NDArray[np.int64]) -> Floats:
        direction = self.quarter.side_directions[sides]
        azimuth = np.radians(session.sun_azimuth)
        towards = direction[:, 1] * np.sin(azimuth) - direction[:, 0] * np.cos(azimuth)
        return np.asarray(np.maximum(0.0, towards))

    def _gather(
        self,
        camera: Camera,
        columns: NDArray[np.int64],
        depth: Floats,
        top: Floats,
        scale: Floats,
        offset: NDArray[np.int64],
        rows: NDArray[np.int64],
        first: int,
        last: int,
        rim: int = 0,
    ) -> Packed:
        """(columns, last - first) texels; `top` is the height of the texture's upper edge."""
        per_row = (scale * depth / camera.focal).astype(np.float32)
        horizon = camera.horizons(FINE)[columns]
        start = (scale * (top - camera.eye) - per_row * horizon).astype(np.float32) + rim
        ys = ((np.arange(first, last) + 0.5) / FINE).astype(np.float32)
        v = per_row[:, None] * ys
        v += start[:, None]
        np.clip(v, 0, (rows - 1)[:, None], out=v)
        index = v.astype(np.int32)
        index += offset.astype(np.int32)[:, None]
        return self.memory.pixels.take(index)

    def _paint_ground(
        self, view: View, camera: Camera, hits: Hits, sides: NDArray[np.int64]
    ) -> None:
        fine_height = view.canvas.shape[1]
        columns = np.arange(view.canvas.shape[0])
        horizon = camera.horizons(FINE)
        contact = _row_of(camera, 0.0, hits.depth, columns)
        first = max(0, int(min(contact.min(), horizon.min() * FINE)))
        if first >= fine_height:
            return
        ys = (np.arange(first, fine_height) + 0.5) / FINE
        below = np.maximum(ys[None, :] - horizon[:, None], 0.4).astype(np.float32)
        depth = np.float32(camera.focal * camera.eye) / below
        slopes = camera.slopes(FINE)
        rays = camera.forward + slopes[:, None] * camera.right
        east = depth * rays[:, :1].astype(np.float32) + np.float32(camera.x % TILE_M)
        north = depth * rays[:, 1:].astype(np.float32) + np.float32(camera.y % TILE_M)
        per_metre = TILE_PIXELS / TILE_M
        level = _level(per_metre, depth[len(depth) // 2], camera, bias=0.6)
        scale = (per_metre / 2.0**level).astype(np.float32)
        mask = (TILE_PIXELS >> level) - 1
        shift = (np.log2(TILE_PIXELS) - level).astype(np.int32)
        cell = (east * scale).astype(np.int32) & mask
        cell <<= shift
        cell += (north * scale).astype(np.int32) & mask
        hit = np.isfinite(hits.depth)
        facing = np.where(hit, np.maximum(hits.facing, 1e-3), 1.0).astype(np.float32)
        wall = np.where(hit, hits.depth, 1e4).astype(np.float32)
        to_wall = (wall[:, None] - depth) * facing[:, None]  # metres before the facade
        asphalt, paving = self._ground_textures()
        road = to_wall > PAVEMENT_M
        base = np.where(
            road, asphalt.offsets[level].astype(np.int32), paving.offsets[level].astype(np.int32)
        )
        texels = self.memory.pixels.take(cell + base)
        kerb = np.abs(to_wall - PAVEMENT_M) < KERB_M / 2
        texels[kerb] = KERB_STONE
        middles = np.array([self.quarter.sides[s].half_width for s in sides], np.float32)
        middle = np.where(hit, middles[hits.plane], 1e6).astype(np.float32)
        directions = self.quarter.side_directions[sides][hits.plane]
        dash = (rays * directions).sum(axis=1).astype(np.float32)
        line = np.abs(to_wall - middle[:, None]) < 0.07
        if line.any():
            line &= ((dash[:, None] * depth) % 4.5) < 1.8
            texels[line] = WHITE_LINE
        shown = (np.arange(first, fine_height)[None, :] >= contact[:, None]) & (
            ys[None, :] > horizon[:, None]
        )
        region = view.canvas[:, first:]
        np.copyto(region, texels, where=shown)
        odd = first % FINE
        coarse = shown[::FINE, odd::FINE]
        start = (first + odd) // FINE
        target = view.depth[:, start : start + coarse.shape[1]]
        np.copyto(target, depth[::FINE, odd::FINE], where=coarse)
        np.copyto(view.sun[:, start : start + coarse.shape[1]], np.float32(0.6), where=coarse)

    def _ground_textures(self) -> tuple[Texture, Texture]:
        return (
            self.memory.get("asphalt", lambda: draw_asphalt(self.quarter.seed), rim=False),
            self.memory.get("paving", lambda: draw_paving(self.quarter.seed), rim=False),
        )

    def _items(
        self, camera: Camera, session: Session, sides: NDArray[np.int64], slopes: Floats
    ) -> Iterable[_Item]:
        away = np.hypot(*(self._middles - camera.position).T)
        for number in np.flatnonzero(away < THINGS_WITHIN_M + 60.0).tolist():
            things = self._standing_at(number)
            for i in _in_sight(camera, [thing.position for thing in things], THINGS_WITHIN_M):
                item = self._billboard(camera, session, things[i])
                if item:
                    yield item
            vehicles = self._vehicles_at(number, session.name)
            for i in _in_sight(camera, [v.position for v in vehicles], THINGS_WITHIN_M):
                for panel in vehicle_panels(vehicles[i], self.catalogue, camera.position):
                    item = _panel_item(camera, panel, slopes)
                    if item:
                        yield item
        for side in sides.tolist():
            blades = self._blades_at(side)
            for i in _in_sight(camera, [foot for foot, _, _ in blades], BLADES_WITHIN_M):
                foot, outwards, index = blades[i]
                away = camera.position - foot
                # Only one of its two faces is turned towards the camera.
                from_right = away[0] * outwards[1] - away[1] * outwards[0] > 0
                start = foot if from_right else foot + outwards * BLADE_REACH_M
                direction = outwards if from_right else -outwards
                panel = Panel(start, direction, self.catalogue.blades[index], ("blade", index))
                item = _panel_item(camera, panel, slopes)
                if item:
                    yield item

    def _standing_at(self, number: int) -> list[Thing]:
        if number not in self._standing:
            street = self.quarter.streets[number]
            self._standing[number] = standing_things(self.quarter, street, self.catalogue)
        return self._standing[number]

    def _vehicles_at(self, number: int, day: str) -> list[Vehicle]:
        key = (number, day)
        if key not in self._vehicles:
            street = self.quarter.streets[number]
            self._vehicles[key] = passing_vehicles(self.quarter, street, day)
        return self._vehicles[key]

    def _blades_at(self, side: int) -> list[tuple[Metres, Metres, int]]:
        if side not in self._blades:
            self._blades[side] = shop_blades(self.quarter, side, self.catalogue)
        return self._blades[side]

    def _billboard(self, camera: Camera, session: Session, thing: Thing) -> _Item | None:
        away = thing.position - camera.position
        depth = float(away @ camera.forward)
        if not NEAREST_M < depth < THINGS_WITHIN_M:
            return None
        if thing.kind == "tree":
            picture = self.catalogue.trees[session.foliage][thing.index]
            key = (f"tree {session.foliage}", thing.index)
        else:
            picture = getattr(self.catalogue, thing.kind)[thing.index]
            key = (thing.kind, thing.index)
        left = float(away @ camera.right) - picture.width / 2
        scale = FINE * camera.focal / depth
        middle = FINE * camera.width / 2
        first = max(0, int(np.ceil(middle + left * scale - 0.5)))
        last = min(FINE * camera.width, int(middle + (left + picture.width) * scale - 0.5) + 1)
        if last <= first:
            return None
        alongs = (np.arange(first, last) + 0.5 - middle) / scale - left
        return _Item(
            depth, first, np.full(last - first, depth), np.asarray(alongs, np.float64), picture, key
        )

    def _paint_item(self, view: View, camera: Camera, item: _Item, walls: Floats) -> None:
        columns = np.arange(item.first, item.first + len(item.depths))
        if not (item.depths < walls[columns] + 0.05).any():
            return
        image = item.picture.image
        texture = self.memory.get(item.key, lambda: image, rim=True)
        finest = image.height / item.picture.height
        level = _level(finest, item.depths, camera)
        scale = finest / 2.0**level
        top = item.picture.bottom + item.picture.height
        column = np.clip((item.alongs * scale).astype(np.int64) + 1, 0, texture.widths[level] - 1)
        offset = texture.offsets[level] + column * texture.heights[level]
        rows = texture.heights[level]
        first = max(0, int(_row_of(camera, top, item.depths, columns).min()) - 1)
        lowest = int(_row_of(camera, item.picture.bottom, item.depths, columns).max())
        last = min(view.canvas.shape[1], lowest + 2)
        if last <= first:
            return
        scales = np.asarray(scale, np.float64)
        tops = np.full(len(columns), top)
        texels = self._gather(
            camera, columns, item.depths, tops, scales, offset, rows, first, last, rim=1
        )
        solid = texels >= 1 << 24
        solid &= (item.depths < walls[columns] + 0.05)[:, None]  # else a house stands before it
        region = view.canvas[item.first : item.first + len(columns), first:last]
        np.copyto(region, texels, where=solid)
        odd_x, odd_y = item.first % FINE, first % FINE
        coarse = solid[odd_x::FINE, odd_y::FINE]
        x, y = (item.first + odd_x) // FINE, (first + odd_y) // FINE
        box = (slice(x, x + coarse.shape[0]), slice(y, y + coarse.shape[1]))
        depths = np.broadcast_to(item.depths[odd_x::FINE, None].astype(np.float32), coarse.shape)
        np.copyto(view.depth[box], depths, where=coarse)
        np.copyto(view.sun[box], np.float32(0.5), where=coarse)


def _in_sight(camera: Camera, positions: list[Metres], within: float) -> list[int]:
    """Which of the positions lie before the camera, not far off, and about in its view."""
    if not positions:
        return []
    away = np.stack(positions) - camera.position
    depth, lateral = away @ camera.forward, away @ camera.right
    reach = depth * (camera.width / 2 / camera.focal) + LARGEST_REACH_M
    seen = (depth > NEAREST_M) & (depth < within) & (np.abs(lateral) < reach)
    return [int(i) for i in np.flatnonzero(seen)]


def _panel_item(camera: Camera, panel: Panel, slopes: Floats) -> _Item | None:
    """The panel's columns; None when it is out of sight."""
    width = panel.picture.width
    ends = np.stack([panel.start, panel.start + panel.direction * width]) - camera.position
    depths, laterals = ends @ camera.forward, ends @ camera.right
    if depths.min() < NEAREST_M or depths.max() > THINGS_WITHIN_M:
        return None
    pixels = FINE * (camera.width / 2 + camera.focal * laterals / depths)
    first, last = max(0, int(pixels[0])), min(FINE * camera.width, int(pixels[1]) + 1)
    if last <= first:
        return None
    hits = cast(
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
    return _Item(
        float(depths.mean()), first + run.start, hits.depth[run], alongs, panel.picture, panel.key
    )


def _level(
    finest: float, depth: NDArray[np.floating], camera: Camera, bias: float = 0.25
) -> NDArray[np.int64]:
    """Which smaller copy to read, so that about one texel falls on one canvas pixel."""
    texels = finest * depth / (camera.focal * FINE)
    return np.asarray(np.clip(np.log2(np.maximum(texels, 1.0)) + bias, 0, LEVELS - 1), np.int64)


def _row_of(camera: Camera, z: float, depth: Floats, columns: NDArray[np.int64]) -> Floats:
    """Canvas row of the height z at the columns' depths."""
    horizon = camera.horizons(FINE)[columns]
    return np.asarray((horizon + camera.focal * (camera.eye - z) / depth) * FINE)
