"""Painting of textures: material codes, walls and the ground, noise, and named random streams.

The fourth byte of a texel is its material code: transparent, solid, emissive, or open to the sky.
The colours are the paint by day; the code says what is lit at night, and what snow lies on.
"""

from __future__ import annotations

import colorsys
import zlib

import numpy as np
from numpy.typing import NDArray
from PIL import Image

CODE_FIRST_PANE = 1
PANE_CODES = 8
"""Codes 1 to 8: window panes; each session lights some of them"""
CODE_SIGN = 21
"""Shop windows and their signs, lit in the evening"""
CODE_LAMP = 22
CODE_FLAT = 30
"""Open to the sky"""
CODE_SOLID = 255

Colour = tuple[int, int, int]
Paint = tuple[int, int, int, int]
GreyImage = NDArray[np.float32]


def random_stream(*key: int | str) -> np.random.Generator:
    """Return the random generator of a key: the same in every process and in any order."""
    return np.random.default_rng(
        [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    )


def colour_of(hue: float, saturation: float, value: float) -> Colour:
    """Convert fractions to a colour; the hue is taken modulo 1."""
    red, green, blue = colorsys.hsv_to_rgb(hue % 1, saturation, value)
    return int(red * 255), int(green * 255), int(blue * 255)


def painted(colour: Colour, factor: float = 1.0, code: int = CODE_SOLID) -> Paint:
    """Return the pixel of a colour, multiplied by a factor, with a material code."""
    red, green, blue = (min(255, int(c * factor)) for c in colour)
    return red, green, blue, code


def emission_table(lit_panes: tuple[int, ...], strength: float) -> NDArray[np.float32]:
    """Return the (256,) float32 emission of each code; 0 by day."""
    table = np.zeros(256, np.float32)
    table[[CODE_FIRST_PANE + pane for pane in lit_panes]] = 0.9 * strength
    table[CODE_SIGN] = 0.9 * strength
    table[CODE_LAMP] = 1.6 * strength
    return table


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cell: int) -> GreyImage:
    """Return seamless (height, width) float32 noise of about [-1, 1] in cells of `cell` pixels."""
    height, width = shape
    coarse = rng.uniform(-1, 1, (max(2, height // cell), max(2, width // cell)))
    image = Image.fromarray(np.pad(coarse.astype(np.float32), 1, mode="wrap"))
    box = (1.0, 1.0, coarse.shape[1] + 1.0, coarse.shape[0] + 1.0)
    return np.asarray(image.resize((width, height), Image.Resampling.BICUBIC, box=box))


def draw_surface(
    rng: np.random.Generator,
    size: int,
    colour: Colour,
    *,
    brick: tuple[int, int] | None = None,
    spread: float = 0.0,
    code: int = CODE_SOLID,
) -> Image.Image:
    """Draw a seamless RGBA tile of `size` x `size` pixels, a power of two, of a mean colour.

    `brick` is the height and length in pixels of bricks, ashlars or slabs in running bond, which
    divide the size; `spread` the standard deviation of their lightness; `code` the material code.
    """
    light = (
        1 + 0.05 * smooth_noise(rng, (size, size), 96) + 0.03 * smooth_noise(rng, (size, size), 24)
    )
    light += 0.025 * rng.standard_normal((size, size), np.float32)
    if brick is not None:
        height, length = brick
        rows, columns = np.mgrid[0:size, 0:size]
        course = rows // height
        columns = (columns + course % 2 * (length // 2)) % size
        lightness = rng.normal(0, spread, (size // height, size // length))
        light += lightness[course, columns // length]
        light -= 0.20 * ((rows % height == 0) | (columns % length == 0))
    pixels = np.full((size, size, 4), code, np.uint8)
    pixels[..., :3] = np.clip(light[..., None] * np.array(colour), 0, 255)
    return Image.fromarray(pixels)
