"""Wall surfaces: tiles of plaster, brick, stone, panels and boards, at PIXELS_PER_METRE."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

PIXELS_PER_METRE = 24
TILE_WIDTH = 512
"""pixels: wider than the widest house"""
TILE_HEIGHT = 576
"""pixels: higher than the highest house"""

WALL_KINDS = ("plaster", "brick", "stone", "panel", "board", "rustic")

Colour = tuple[int, int, int]
GreyImage = NDArray[np.float32]


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cell: int) -> GreyImage:
    """(height, width) float32 of about [-1, 1] that varies over `cell` pixels; wraps around."""
    height, width = shape
    coarse = rng.uniform(-1, 1, (max(2, height // cell), max(2, width // cell)))
    image = Image.fromarray(np.pad(coarse.astype(np.float32), 1, mode="wrap"))
    rows, columns = coarse.shape
    box = (1 / 2 + 0.5, 1 / 2 + 0.5, columns + 1, rows + 1)
    return np.asarray(image.resize((width, height), Image.Resampling.BICUBIC, box=box))


def draw_wall(kind: str, colour: Colour, rng: np.random.Generator) -> Image.Image:
    """One RGB tile of TILE_WIDTH x TILE_HEIGHT pixels."""
    shape = (TILE_HEIGHT, TILE_WIDTH)
    grain = rng.normal(0, 1, shape).astype(np.float32)
    light = 1 + 0.05 * smooth_noise(rng, shape, 96) + 0.03 * smooth_noise(rng, shape, 24)
    rows, columns = np.mgrid[0:TILE_HEIGHT, 0:TILE_WIDTH]
    if kind == "plaster":
        light += 0.02 * grain
        light -= 0.05 * np.maximum(0, smooth_noise(rng, shape, 40))  # stains
    elif kind == "brick":
        light += _courses(rows, columns, rng, height=5, length=12, joint=1, spread=0.10)
        light += 0.02 * grain
    elif kind == "stone":
        light += _courses(rows, columns, rng, height=14, length=30, joint=1, spread=0.06)
        light += 0.03 * grain
    elif kind == "rustic":
        light += _courses(rows, columns, rng, height=9, length=18, joint=2, spread=0.13)
        light += 0.05 * grain
    elif kind == "panel":
        seams = (rows % 72 < 2) | (columns % 64 < 2)
        light += 0.015 * grain - 0.16 * seams
    elif kind == "board":
        light += -0.16 * (rows % 6 == 0) + 0.04 * (rows % 6 / 6) + 0.015 * grain
    else:
        raise ValueError(f"no such wall: {kind}")
    painted = light[..., None] * np.asarray(colour, np.float32)
    return Image.fromarray(np.clip(painted, 0, 255).astype(np.uint8))


def _courses(
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    rng: np.random.Generator,
    *,
    height: int,
    length: int,
    joint: int,
    spread: float,
) -> GreyImage:
    """Bricks or ashlars in running bond: each with its own lightness, dark joints between."""
    course = rows // height
    shifted = columns + (course % 2) * (length // 2)
    unit = shifted // length
    lightness = rng.normal(0, spread, (int(course.max()) + 1, int(unit.max()) + 1))
    joints = (rows % height < joint) | (shifted % length < joint)
    return np.asarray(lightness[course, unit] - 0.20 * joints, np.float32)
