"""The ground: asphalt and paving slabs as tiles that repeat over the whole city."""

from __future__ import annotations

import numpy as np
from PIL import Image

from shared.datasets.city.codes import FLAT
from shared.datasets.city.random_streams import stream
from shared.datasets.city.walls import Grey, smooth_noise

TILE_PIXELS = 512
TILE_M = 16.0


def draw_asphalt(seed: int) -> Image.Image:
    """A square tile of TILE_M metres that wraps around."""
    rng = stream(seed, "asphalt")
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
    rng = stream(seed, "paving")
    rows, columns = np.mgrid[0:TILE_PIXELS, 0:TILE_PIXELS]
    slab = TILE_PIXELS // 32
    shades = rng.normal(0, 0.025, (32, 33))
    course = rows // slab
    shifted = columns + (course % 2) * (slab // 2)
    light = 0.60 + shades[course, shifted // slab]
    light -= 0.09 * ((rows % slab < 1) | (shifted % slab < 1))
    light += 0.03 * smooth_noise(rng, light.shape, 64)
    return _tile(light.astype(np.float32), (1.02, 1.0, 0.96))


def _tile(light: Grey, tint: tuple[float, float, float]) -> Image.Image:
    colours = np.clip(light[..., None] * np.asarray(tint) * 255, 0, 255).astype(np.uint8)
    codes = np.full((*light.shape, 1), FLAT, np.uint8)
    return Image.fromarray(np.concatenate([colours, codes], axis=2))
