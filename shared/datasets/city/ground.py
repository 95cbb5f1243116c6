"""The ground: asphalt and paving slabs as tiles that repeat over the whole city, in perspective."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from shared.datasets.city.camera import Camera, RayHits
from shared.datasets.city.canvas import SUPERSAMPLING, RenderBuffers, choose_mip_level, project_row
from shared.datasets.city.codes import CODE_FLAT
from shared.datasets.city.random_streams import random_stream
from shared.datasets.city.streets import PAVEMENT_M, Quarter
from shared.datasets.city.texture_memory import TextureCache
from shared.datasets.city.walls import GreyImage, smooth_noise

TILE_PIXELS = 512
TILE_M = 16.0
KERB_M = 0.16
WHITE_LINE = np.uint32(CODE_FLAT << 24 | 0xC8CCCC)
KERB_STONE = np.uint32(CODE_FLAT << 24 | 0x8E9498)


def draw_asphalt(seed: int) -> Image.Image:
    """A square tile of TILE_M metres that wraps around."""
    rng = random_stream(seed, "asphalt")
    light = 0.42 + 0.012 * rng.normal(0, 1, (TILE_PIXELS, TILE_PIXELS)).astype(np.float32)
    light += 0.03 * smooth_noise(rng, light.shape, 64) + 0.015 * smooth_noise(rng, light.shape, 16)
    for _ in range(5):  # patches where it was mended
        x, y = rng.integers(0, TILE_PIXELS - 90, 2)
        wide, high = rng.integers(24, 90, 2)
        light[y : y + high, x : x + wide] += rng.uniform(-0.05, 0.02)
    x, y = rng.integers(60, TILE_PIXELS - 60, 2)
    rows, columns = np.mgrid[0:TILE_PIXELS, 0:TILE_PIXELS]
    cover = (rows - y) ** 2 + (columns - x) ** 2
    light[cover < 11**2] = 0.24
    light[cover < 9**2] += 0.05 * ((rows + columns)[cover < 9**2] % 4 < 2)
    return _tile(light, (1.0, 1.0, 1.03))


def draw_paving(seed: int) -> Image.Image:
    """A square tile of TILE_M metres that wraps around: slabs of half a metre."""
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


def paint_ground(
    view: RenderBuffers,
    camera: Camera,
    hits: RayHits,
    quarter: Quarter,
    sides: NDArray[np.int64],
    memory: TextureCache,
) -> None:
    """Paint what lies below the houses' feet; `hits` are those against the quarter's `sides`."""
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
    to_wall = (wall[:, None] - depth) * facing[:, None]  # metres before the facade
    asphalt = memory.get("asphalt", lambda: draw_asphalt(quarter.seed), rim=False)
    paving = memory.get("paving", lambda: draw_paving(quarter.seed), rim=False)
    road = to_wall > PAVEMENT_M
    base = np.where(
        road, asphalt.offsets[level].astype(np.int32), paving.offsets[level].astype(np.int32)
    )
    texels = memory.pixels.take(cell + base)
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
