"""Textures of facades: walls, windows, doors; material codes; named random streams.

The fourth byte of a texture's pixel is a material code: transparent, solid, or emissive. The three
colours of a pixel are its paint by day; the code selects what emits light at night, and which
surfaces carry snow. It is one byte, so that all copies of a texture carry it with the colours.

`random_stream` returns independent random streams by name, so that no result depends on the order
of drawing.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

PIXELS_PER_METRE = 24
TILE_WIDTH = 512
"""Pixels; wider than the widest house"""
TILE_HEIGHT = 576
"""Pixels; higher than the highest house"""

WALL_KINDS = ("plaster", "brick", "stone", "panel", "board", "rustic")

Colour = tuple[int, int, int]
GreyImage = NDArray[np.float32]


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cell: int) -> GreyImage:
    """Return seamless (height, width) float32 noise of about [-1, 1] in cells of `cell` pixels."""
    height, width = shape
    coarse = rng.uniform(-1, 1, (max(2, height // cell), max(2, width // cell)))
    image = Image.fromarray(np.pad(coarse.astype(np.float32), 1, mode="wrap"))
    rows, columns = coarse.shape
    box = (1 / 2 + 0.5, 1 / 2 + 0.5, columns + 1, rows + 1)
    return np.asarray(image.resize((width, height), Image.Resampling.BICUBIC, box=box))


def draw_wall(kind: str, colour: Colour, rng: np.random.Generator) -> Image.Image:
    """Draw an RGB tile of TILE_WIDTH x TILE_HEIGHT pixels; `kind` is one of WALL_KINDS."""
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
        raise ValueError(f"unknown wall kind {kind!r}")
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
    """Return the lightness of bricks or ashlars in running bond with dark joints."""
    course = rows // height
    shifted = columns + (course % 2) * (length // 2)
    unit = shifted // length
    lightness = rng.normal(0, spread, (int(course.max()) + 1, int(unit.max()) + 1))
    joints = (rows % height < joint) | (shifted % length < joint)
    return np.asarray(lightness[course, unit] - 0.20 * joints, np.float32)


def random_stream(*key: int | str) -> np.random.Generator:
    """Return the random generator of a key: the same in every process and in any order."""
    return np.random.default_rng(
        [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    )


CODE_FIRST_PANE = 1
PANE_CODES = 8
"""Codes 1 to 8: window panes; each session lights some of them"""
CODE_SHOP = 20
"""Shop windows, lit in the evening"""
CODE_SIGN = 21
CODE_LAMP = 22
"""Lamps and headlights"""
CODE_FLAT = 30
"""Surfaces open to the sky, which carry snow"""
CODE_SOLID = 255


def emission_table(lit_panes: tuple[int, ...], strength: float) -> NDArray[np.float32]:
    """Return the (256,) float32 emission of each code; 0 by day."""
    table = np.zeros(256, np.float32)
    for pane in lit_panes:
        table[CODE_FIRST_PANE + pane] = 0.9 * strength
    table[CODE_SHOP] = 1.0 * strength
    table[CODE_SIGN] = 0.8 * strength
    table[CODE_LAMP] = 1.6 * strength
    return table


GLASS: tuple[Colour, ...] = ((70, 86, 100), (84, 98, 108), (58, 70, 82), (96, 112, 122))
CURTAINS: tuple[Colour, ...] = ((214, 208, 196), (196, 184, 160), (224, 224, 222), (170, 150, 136))


@dataclass(frozen=True, slots=True)
class WindowType:
    """A type of window; metres."""

    width: float
    height: float
    mullions: int
    """Vertical bars between the panes"""
    transoms: int
    """Horizontal bars between the panes"""
    frame: Colour
    surround: Colour
    surround_width: float
    arched: bool
    shutters: Colour | None
    pediment: bool
    balcony: bool


def to_pixels(metres: float) -> int:
    """Convert metres to pixels of a facade's texture."""
    return round(metres * PIXELS_PER_METRE)


def darken(colour: Colour, factor: float) -> Colour:
    """Multiply a colour by a factor, clipped to 255."""
    red, green, blue = (min(255, int(c * factor)) for c in colour)
    return red, green, blue


def painted(
    colour: Colour, factor: float = 1.0, code: int = CODE_SOLID
) -> tuple[int, int, int, int]:
    """Return the pixel of a colour, multiplied by a factor, with a material code."""
    return (*darken(colour, factor), code)


def draw_window(kind: WindowType, variant: int, rng: np.random.Generator) -> Image.Image:
    """Draw a window as RGBA with material codes; `variant` is below PANE_CODES."""
    width, height, edge = (
        to_pixels(kind.width),
        to_pixels(kind.height),
        max(1, to_pixels(kind.surround_width)),
    )
    wing = to_pixels(kind.width * 0.48) if kind.shutters else 0
    top = edge + (to_pixels(0.28) if kind.pediment else 0) + (width // 3 if kind.arched else 0)
    rail = to_pixels(0.95) if kind.balcony else 0
    side = max(wing, to_pixels(0.35) if kind.balcony else 0) + edge
    picture = Image.new("RGBA", (width + 2 * side, top + height + edge + 3), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    left, right, bottom = side, side + width - 1, top + height - 1
    trim = painted(kind.surround)
    glass = (*GLASS[int(rng.integers(len(GLASS)))], CODE_FIRST_PANE + variant % PANE_CODES)
    if kind.arched:
        draw.ellipse(
            (left - edge, top - width // 2 - edge, right + edge, top + width // 2 + edge), fill=trim
        )
        draw.ellipse((left, top - width // 2, right, top + width // 2), fill=glass)
    draw.rectangle(
        (left - edge, top if kind.arched else top - edge, right + edge, bottom + edge), fill=trim
    )
    draw.rectangle((left, top, right, bottom), fill=glass)
    # Reflection of the sky in the upper half.
    for row in range(top, top + height // 2):
        mirrored = darken(glass[:3], 1.32 - 0.32 * (row - top) / max(1, height // 2))
        draw.line((left, row, right, row), fill=(*mirrored, glass[3]))
    _curtain(draw, (left, top, right, bottom), variant, glass[3], rng)
    frame = painted(kind.frame)
    draw.rectangle((left, top, right, bottom), outline=frame, width=2)
    for bar in range(1, kind.mullions + 1):
        x = left + bar * width // (kind.mullions + 1)
        draw.line((x, top, x, bottom), fill=frame, width=2)
    for bar in range(1, kind.transoms + 1):
        y = top + bar * height // (kind.transoms + 1)
        draw.line((left, y, right, y), fill=frame, width=1)
    draw.line((left, top, right, top), fill=painted(kind.surround, 0.45), width=2)
    sill = darken(kind.surround, 1.06)
    draw.rectangle((left - edge - 2, bottom + 1, right + edge + 2, bottom + 3), fill=painted(sill))
    draw.line((left - edge, bottom + 4, right + edge, bottom + 4), fill=painted(sill, 0.5))
    if kind.pediment:
        _pediment(draw, left - edge - 2, right + edge + 2, top - edge, kind.surround)
    if kind.shutters:
        for x in (left - edge - wing, right + edge + 1):
            _shutter(draw, (x, top, x + wing - 1, bottom), kind.shutters)
    if kind.balcony:
        _railing(draw, (1, bottom - rail + 2, picture.width - 2, bottom + 2))
    return picture


def _curtain(
    draw: ImageDraw.ImageDraw,
    box: tuple[int, int, int, int],
    variant: int,
    code: int,
    rng: np.random.Generator,
) -> None:
    left, top, right, bottom = box
    cloth = CURTAINS[int(rng.integers(len(CURTAINS)))]
    fill = (*cloth, code)
    width, height = right - left, bottom - top
    style = variant % 5
    if style == 1:  # open curtains
        draw.rectangle((left, top, left + width // 4, bottom), fill=fill)
        draw.rectangle((right - width // 4, top, right, bottom), fill=fill)
    elif style == 2:  # a partly lowered blind
        draw.rectangle((left, top, right, top + int(height * rng.uniform(0.3, 0.7))), fill=fill)
    elif style == 3:  # half-height net curtain
        draw.rectangle((left, top + height // 2, right, bottom), fill=fill)
    elif style == 4 and variant > 4:  # closed
        draw.rectangle(box, fill=fill)


def _pediment(
    draw: ImageDraw.ImageDraw, left: int, right: int, bottom: int, colour: Colour
) -> None:
    draw.rectangle((left, bottom - 3, right, bottom - 1), fill=painted(colour, 1.05))
    draw.polygon(
        [(left, bottom - 4), (right, bottom - 4), ((left + right) // 2, bottom - 9)],
        fill=painted(colour),
    )
    draw.line((left, bottom, right, bottom), fill=painted(colour, 0.55))


def _shutter(draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], colour: Colour) -> None:
    draw.rectangle(box, fill=painted(colour), outline=painted(colour, 0.7))
    for y in range(box[1] + 3, box[3] - 1, 3):
        draw.line((box[0] + 2, y, box[2] - 2, y), fill=painted(colour, 0.82))


def _railing(draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int]) -> None:
    left, top, right, bottom = box
    iron = (44, 46, 50, CODE_SOLID)
    draw.rectangle((left, bottom - 3, right, bottom), fill=(150, 146, 138, CODE_SOLID))
    draw.line((left, top, right, top), fill=iron, width=2)
    for x in range(left, right + 1, 4):
        draw.line((x, top, x, bottom - 3), fill=iron)


def draw_door(colour: Colour, panels: int, glazed: bool, rng: np.random.Generator) -> Image.Image:
    """Draw a door of about 1.3 x 2.6 m with frame and steps, RGBA with material codes."""
    width, height = to_pixels(1.3), to_pixels(2.6)
    picture = Image.new("RGBA", (width + 8, height + 4), (168, 162, 150, CODE_SOLID))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((4, 4, width + 3, height + 3), fill=painted(colour))
    light = height // 5
    draw.rectangle(
        (6, 6, width + 1, light), fill=(*GLASS[0], CODE_FIRST_PANE + int(rng.integers(PANE_CODES)))
    )
    rows = max(1, panels)
    for row in range(rows):
        y0 = light + 5 + row * (height - light - 4) // rows
        y1 = light + 1 + (row + 1) * (height - light - 4) // rows
        for x0, x1 in ((7, width // 2 + 1), (width // 2 + 5, width)):
            if glazed and row == 0:
                draw.rectangle((x0, y0, x1, y1), fill=(*GLASS[1], CODE_FIRST_PANE + 3))
            else:
                draw.rectangle((x0, y0, x1, y1), outline=painted(colour, 0.62))
                draw.line((x0, y0, x1, y0), fill=painted(colour, 1.3))
    draw.line((width // 2 + 3, light, width // 2 + 3, height), fill=painted(colour, 0.5))
    draw.rectangle((0, height + 1, width + 7, height + 3), fill=(140, 136, 128, CODE_SOLID))
    return picture


def draw_shop_glass(width: int, height: int, rng: np.random.Generator) -> Image.Image:
    """Draw a shop window of `width` x `height` pixels with goods on display."""
    picture = Image.new("RGBA", (width, height), painted(GLASS[2], 0.9, CODE_SHOP))
    draw = ImageDraw.Draw(picture)
    for row in range(height // 2):
        shade = darken(GLASS[1], 1.15 - 0.4 * row / max(1, height // 2))
        draw.line((0, row, width, row), fill=(*shade, CODE_SHOP))
    x = int(rng.integers(2, 8))
    while x < width - 6:
        wide, high = int(rng.integers(4, 14)), int(height * rng.uniform(0.15, 0.55))
        hue = rng.integers(60, 220, 3)
        fill = (int(hue[0]), int(hue[1]), int(hue[2]), CODE_SHOP)
        draw.rectangle((x, height - 3 - high, min(width - 3, x + wide), height - 3), fill=fill)
        x += wide + int(rng.integers(3, 16))
    draw.line((width // 5, height - 1, width // 3, 0), fill=(168, 182, 190, CODE_SHOP), width=2)
    return picture
