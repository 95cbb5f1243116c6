"""Renderer: facades by ray casting, the ground, and sprites in front of them, sorted by depth.

The ground is asphalt and paving tiles that repeat over the whole city, in perspective.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lab.city.camera import (
    SUPERSAMPLING,
    Camera,
    Floats,
    RayHits,
    RenderBuffers,
    TextureCache,
    cast_rays,
    choose_mip_level,
    project_row,
    sample_texture,
)
from lab.city.catalogue import Catalogue
from lab.city.houses import draw_house
from lab.city.scene import OBJECT_RANGE_M, VisibleObjects, VisibleSprite
from lab.city.sessions import CaptureSession
from lab.city.streets import PAVEMENT_M, Quarter
from lab.city.textures import (
    CODE_FLAT,
    PIXELS_PER_METRE,
    GreyImage,
    random_stream,
    smooth_noise,
)

TILE_PIXELS = 512
TILE_M = 16.0
KERB_M = 0.16
WHITE_LINE = np.uint32(CODE_FLAT << 24 | 0xC8CCCC)
KERB_STONE = np.uint32(CODE_FLAT << 24 | 0x8E9498)


def _draw_asphalt(seed: int) -> Image.Image:
    """Draw a seamless square tile of TILE_M metres."""
    rng = random_stream(seed, "asphalt")
    light = 0.42 + 0.012 * rng.normal(0, 1, (TILE_PIXELS, TILE_PIXELS)).astype(np.float32)
    light += 0.03 * smooth_noise(rng, light.shape, 64) + 0.015 * smooth_noise(rng, light.shape, 16)
    for _ in range(5):  # repaired patches
        x, y = rng.integers(0, TILE_PIXELS - 90, 2)
        wide, high = rng.integers(24, 90, 2)
        light[y : y + high, x : x + wide] += rng.uniform(-0.05, 0.02)
    x, y = rng.integers(60, TILE_PIXELS - 60, 2)
    rows, columns = np.mgrid[0:TILE_PIXELS, 0:TILE_PIXELS]
    cover = (rows - y) ** 2 + (columns - x) ** 2
    light[cover < 11**2] = 0.24
    light[cover < 9**2] += 0.05 * ((rows + columns)[cover < 9**2] % 4 < 2)
    return _tile(light, (1.0, 1.0, 1.03))


def _draw_paving(seed: int) -> Image.Image:
    """Draw a seamless square tile of TILE_M metres: slabs of half a metre."""
    rng = random_stream(seed, "paving")
    rows, columns = np.mgrid[0:TILE_PIXELS, 0:TILE_PIXELS]
    slab = TILE_PIXELS // 32
    shades = rng.normal(0, 0.025, (32, 33))
    course = rows // slab
    shifted = columns + (course % 2) * (slab // 2)
    light = 0.60 + shades[course, shifted // slab]
    light -= 0.09 * ((rows % slab < 1) | (shifted % slab < 1))
    light += 0.03 * smooth_noise(rng, light.shape, 64)
    return _tile(light.astype(np.float32), (1.02, 1.0, 0.96))


def _tile(light: GreyImage, tint: tuple[float, float, float]) -> Image.Image:
    colours = np.clip(light[..., None] * np.asarray(tint) * 255, 0, 255).astype(np.uint8)
    codes = np.full((*light.shape, 1), CODE_FLAT, np.uint8)
    return Image.fromarray(np.concatenate([colours, codes], axis=2))


def _paint_ground(
    view: RenderBuffers,
    camera: Camera,
    hits: RayHits,
    quarter: Quarter,
    sides: NDArray[np.int64],
    cache: TextureCache,
) -> None:
    """Paint the ground in front of the facades.

    `hits`: the ray hits on the facade rows `sides` of the quarter.
    """
    fine_height = view.canvas.shape[1]
    columns = np.arange(view.canvas.shape[0])
    horizon = camera.horizons(SUPERSAMPLING)
    contact = project_row(camera, 0.0, hits.depth, columns)
    first = max(0, int(min(contact.min(), horizon.min() * SUPERSAMPLING)))
    if first >= fine_height:
        return
    ys = (np.arange(first, fine_height) + 0.5) / SUPERSAMPLING
    below = np.maximum(ys[None, :] - horizon[:, None], 0.4).astype(np.float32)
    depth = np.float32(camera.focal * camera.eye) / below
    slopes = camera.slopes(SUPERSAMPLING)
    rays = camera.forward + slopes[:, None] * camera.right
    east = depth * rays[:, :1].astype(np.float32) + np.float32(camera.x % TILE_M)
    north = depth * rays[:, 1:].astype(np.float32) + np.float32(camera.y % TILE_M)
    per_metre = TILE_PIXELS / TILE_M
    level = choose_mip_level(per_metre, depth[len(depth) // 2], camera, bias=0.6)
    scale = (per_metre / 2.0**level).astype(np.float32)
    mask = (TILE_PIXELS >> level) - 1
    shift = (np.log2(TILE_PIXELS) - level).astype(np.int32)
    cell = (east * scale).astype(np.int32) & mask
    cell <<= shift
    cell += (north * scale).astype(np.int32) & mask
    hit = np.isfinite(hits.depth)
    facing = np.where(hit, np.maximum(hits.facing, 1e-3), 1.0).astype(np.float32)
    wall = np.where(hit, hits.depth, 1e4).astype(np.float32)
    to_wall = (wall[:, None] - depth) * facing[:, None]  # metres in front of the facade
    asphalt = cache.get("asphalt", lambda: _draw_asphalt(quarter.seed), rim=False)
    paving = cache.get("paving", lambda: _draw_paving(quarter.seed), rim=False)
    road = to_wall > PAVEMENT_M
    base = np.where(
        road, asphalt.offsets[level].astype(np.int32), paving.offsets[level].astype(np.int32)
    )
    texels = cache.pixels.take(cell + base)
    kerb = np.abs(to_wall - PAVEMENT_M) < KERB_M / 2
    texels[kerb] = KERB_STONE
    middles = np.array([quarter.sides[s].half_width for s in sides], np.float32)
    middle = np.where(hit, middles[hits.plane], 1e6).astype(np.float32)
    directions = quarter.side_directions[sides][hits.plane]
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
    odd = first % SUPERSAMPLING
    coarse = shown[::SUPERSAMPLING, odd::SUPERSAMPLING]
    start = (first + odd) // SUPERSAMPLING
    target = view.depth[:, start : start + coarse.shape[1]]
    np.copyto(target, depth[::SUPERSAMPLING, odd::SUPERSAMPLING], where=coarse)
    np.copyto(view.sun[:, start : start + coarse.shape[1]], np.float32(0.6), where=coarse)


FACADE_RANGE_M = 190.0
LAMP_SPACING_M = 25.0


class QuarterRenderer:
    """Renders views of one quarter; caches textures and street objects."""

    def __init__(self, quarter: Quarter, catalogue: Catalogue, cache: TextureCache) -> None:
        self.quarter = quarter
        self.catalogue = catalogue
        self.cache = cache
        self._objects = VisibleObjects(quarter, catalogue)
        self._side_middles = (
            quarter.side_starts + quarter.side_directions * quarter.side_lengths[:, None] / 2
        )

    def view(self, camera: Camera, session: CaptureSession) -> RenderBuffers:
        """Render the view of a camera on the day of a session, without lighting."""
        width, height = camera.width, camera.height
        view = RenderBuffers(
            canvas=np.zeros((width * SUPERSAMPLING, height * SUPERSAMPLING), np.uint32),
            depth=np.full((width, height), np.inf, np.float32),
            sun=np.ones((width, height), np.float32),
            lamp=np.zeros(width, np.float32),
        )
        near = np.hypot(*(self._side_middles - camera.position).T)
        sides = np.flatnonzero(near < FACADE_RANGE_M)
        slopes = camera.slopes(SUPERSAMPLING)
        hits = cast_rays(
            camera,
            slopes,
            self.quarter.side_starts[sides],
            self.quarter.side_directions[sides],
            self.quarter.side_lengths[sides],
        )
        self._paint_facades(view, camera, session, hits, sides)
        _paint_ground(view, camera, hits, self.quarter, sides, self.cache)
        for item in sorted(
            self._objects.items(camera, session, sides[near[sides] < OBJECT_RANGE_M], slopes),
            key=lambda item: -item.depth,
        ):
            self._paint_item(view, camera, item, hits.depth)
        return view

    def _paint_facades(
        self,
        view: RenderBuffers,
        camera: Camera,
        session: CaptureSession,
        hits: RayHits,
        sides: NDArray[np.int64],
    ) -> None:
        columns = np.flatnonzero(np.isfinite(hits.depth))
        if not len(columns):
            return
        depth, along = hits.depth[columns], hits.along[columns]
        side = sides[hits.plane[columns]]
        plot = np.empty(len(columns), np.int64)
        for number in np.unique(side):
            rows_of_side = side == number
            cuts = self.quarter.sides[number].cuts
            plots = np.searchsorted(cuts, along[rows_of_side], side="right") - 1
            plot[rows_of_side] = np.clip(plots, 0, len(cuts) - 2)
        level = choose_mip_level(PIXELS_PER_METRE, depth, camera)
        offset = np.empty(len(columns), np.int64)
        rows = np.empty(len(columns), np.int64)
        top = np.empty(len(columns))
        houses = sorted(set(zip(side.tolist(), plot.tolist(), strict=True)))
        self.cache.reserve(
            {self._key(*house): self.quarter.house(*house).pixels for house in houses}
        )
        for number, lot in houses:
            house_columns = np.flatnonzero((side == number) & (plot == lot))
            house = self.quarter.house(number, lot)
            texture = self.cache.get(
                self._key(number, lot), partial(draw_house, house, self.catalogue), rim=False
            )
            levels = level[house_columns]
            scale = PIXELS_PER_METRE / 2.0**levels
            across = (along[house_columns] - self.quarter.sides[number].cuts[lot]) * scale
            column = np.clip(across.astype(np.int64), 0, texture.widths[levels] - 1)
            offset[house_columns] = texture.offsets[levels] + column * texture.heights[levels]
            rows[house_columns] = texture.heights[levels]
            top[house_columns] = house.top
        bottom = project_row(camera, 0.0, depth, columns)
        last = min(view.canvas.shape[1], int(bottom.max()) + 1)
        scale = PIXELS_PER_METRE / 2.0**level
        block = sample_texture(
            self.cache, camera, columns, depth, top, scale, offset, rows, 0, last
        )
        block *= block >= 1 << 24
        view.canvas[columns, :last] = block
        coarse = np.flatnonzero(columns % SUPERSAMPLING == 0)
        xs = columns[coarse] // SUPERSAMPLING
        solid = block[coarse, ::SUPERSAMPLING] > 0
        region = view.depth[xs, : solid.shape[1]]
        view.depth[xs, : solid.shape[1]] = np.where(solid, depth[coarse, None], region)
        view.sun[xs] = self._sunlit(session, side[coarse])[:, None]
        wave = 0.5 + 0.5 * np.cos(along[coarse] * (2 * np.pi / LAMP_SPACING_M))
        view.lamp[xs] = wave * np.exp(-depth[coarse] / 60.0)

    def _key(self, side: int, plot: int) -> tuple[str, int, int]:
        return (self.quarter.name, side, plot)

    def _sunlit(self, session: CaptureSession, sides: NDArray[np.int64]) -> Floats:
        direction = self.quarter.side_directions[sides]
        azimuth = np.radians(session.sun_azimuth)
        towards = direction[:, 1] * np.sin(azimuth) - direction[:, 0] * np.cos(azimuth)
        return np.asarray(np.maximum(0.0, towards))

    def _paint_item(
        self, view: RenderBuffers, camera: Camera, item: VisibleSprite, walls: Floats
    ) -> None:
        """Paint a sprite over the view; `walls` are the depths of the facades by column."""
        columns = np.arange(item.first, item.first + len(item.depths))
        if not (item.depths < walls[columns] + 0.05).any():
            return
        image = item.picture.image
        texture = self.cache.get(item.key, lambda: image, rim=True)
        finest = image.height / item.picture.height
        level = choose_mip_level(finest, item.depths, camera)
        scale = finest / 2.0**level
        top = item.picture.bottom + item.picture.height
        column = np.clip((item.alongs * scale).astype(np.int64) + 1, 0, texture.widths[level] - 1)
        offset = texture.offsets[level] + column * texture.heights[level]
        rows = texture.heights[level]
        first = max(0, int(project_row(camera, top, item.depths, columns).min()) - 1)
        lowest = int(project_row(camera, item.picture.bottom, item.depths, columns).max())
        last = min(view.canvas.shape[1], lowest + 2)
        if last <= first:
            return
        scales = np.asarray(scale, np.float64)
        tops = np.full(len(columns), top)
        texels = sample_texture(
            self.cache,
            camera,
            columns,
            item.depths,
            tops,
            scales,
            offset,
            rows,
            first,
            last,
            rim=1,
        )
        solid = texels >= 1 << 24
        solid &= (item.depths < walls[columns] + 0.05)[:, None]  # else a house hides it
        region = view.canvas[item.first : item.first + len(columns), first:last]
        np.copyto(region, texels, where=solid)
        odd_x, odd_y = item.first % SUPERSAMPLING, first % SUPERSAMPLING
        coarse = solid[odd_x::SUPERSAMPLING, odd_y::SUPERSAMPLING]
        x, y = (item.first + odd_x) // SUPERSAMPLING, (first + odd_y) // SUPERSAMPLING
        box = (slice(x, x + coarse.shape[0]), slice(y, y + coarse.shape[1]))
        depths = np.broadcast_to(
            item.depths[odd_x::SUPERSAMPLING, None].astype(np.float32), coarse.shape
        )
        np.copyto(view.depth[box], depths, where=coarse)
        np.copyto(view.sun[box], np.float32(0.5), where=coarse)
