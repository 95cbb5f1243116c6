"""Houses: the style that all houses of a city share, and facades arranged from its parts.

A style is small on purpose: a thousand places share its parts, so that no part identifies a place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lab.city.textures import (
    CODE_FIRST_PANE,
    CODE_FLAT,
    CODE_SIGN,
    PANE_CODES,
    Colour,
    colour_of,
    draw_surface,
    painted,
    random_stream,
)

PIXELS_PER_METRE = 24
TILE_PIXELS = 512
MASONRY = ((None, 0.0), ((4, 8), 0.10), ((16, 32), 0.08))
"""Bricks in pixels and the spread of their lightness: plaster, brick, stone"""
WALLS = 8
WINDOWS = 7
DOORS = 5
SHOPS = 12
SYLLABLES = (
    "ba be bo ca da do el fa gi ko la li lo ma mi mo na ni no pa pe ra ri ro sa so ta ti to va zo"
)
GLASS: tuple[Colour, ...] = ((70, 86, 100), (84, 98, 108), (58, 70, 82), (96, 112, 122))
CURTAINS: tuple[Colour, ...] = ((214, 208, 196), (196, 184, 160), (224, 224, 222), (170, 150, 136))
HEADROOM_M = 3.0
"""Above the eaves, for the roof and its chimneys; partly transparent"""


@dataclass(frozen=True, slots=True)
class HouseStyle:
    """The parts of the houses of a city, as RGBA images with material codes."""

    walls: list[Image.Image]
    windows: list[list[Image.Image]]
    """By type, then by code of its pane"""
    doors: list[Image.Image]
    signs: list[Image.Image]
    """Of shops"""
    trims: list[Colour]
    roofs: list[Colour]


def make_house_style(seed: int) -> HouseStyle:
    """Draw the style of a seed."""
    rng = random_stream(seed, "houses")
    hue = rng.uniform(0.04, 0.16)  # of the city's stone, from pink through ochre to straw
    walls = []
    for number in range(WALLS):
        colour = colour_of(
            hue + rng.normal(0, 0.025), rng.uniform(0.10, 0.42), rng.uniform(0.55, 0.88)
        )
        brick, spread = MASONRY[number // 2 % 3 if number % 2 else 0]
        walls.append(draw_surface(rng, TILE_PIXELS, colour, brick=brick, spread=spread))
    trims = [colour_of(hue, rng.uniform(0.04, 0.16), v) for v in (0.94, 0.86, 0.74, 0.58)]
    accents = [
        colour_of(rng.uniform(), rng.uniform(0.35, 0.75), rng.uniform(0.3, 0.7)) for _ in range(6)
    ]
    return HouseStyle(
        walls=walls,
        windows=[_draw_windows(rng, trims) for _ in range(WINDOWS)],
        doors=[_draw_door(rng, accents[number]) for number in range(DOORS)],
        signs=[_draw_sign(rng, accents[number % 6]) for number in range(SHOPS)],
        trims=trims,
        roofs=[colour_of(hue - 0.03, s, v) for s, v in ((0.5, 0.5), (0.1, 0.36), (0.2, 0.46))],
    )


def _pixels(metres: float) -> int:
    return round(metres * PIXELS_PER_METRE)


def _draw_windows(rng: np.random.Generator, trims: list[Colour]) -> list[Image.Image]:
    """Draw the variants of a type of window, one for each code of a pane."""
    width, height = (_pixels(rng.choice(sizes)) for sizes in ([0.95, 1.2, 1.6], [1.35, 1.65, 2.0]))
    edge = _pixels(rng.choice([0.05, 0.12, 0.18]))
    bars_across, bars_up = (int(count) for count in rng.integers(0, 3, 2))
    frame = painted((236, 234, 228) if rng.uniform() < 0.7 else (52, 50, 48))
    trim = trims[int(rng.integers(3))]
    shutter = colour_of(rng.uniform(0.2, 0.6), 0.35, 0.42) if rng.uniform() < 0.3 else None
    balcony = rng.uniform() < 0.25
    side = edge + (width // 2 if shutter else 3)
    left, top, right, bottom = side, edge, side + width - 1, edge + height - 1
    windows = []
    for variant in range(PANE_CODES):
        code = CODE_FIRST_PANE + variant
        picture = Image.new("RGBA", (width + 2 * side, height + 2 * edge + 3), (0, 0, 0, 0))
        draw = ImageDraw.Draw(picture)
        draw.rectangle((left - edge, 0, right + edge, bottom + edge), fill=painted(trim))
        glass = GLASS[int(rng.integers(len(GLASS)))]
        for row in range(top, bottom + 1):  # the sky is mirrored in the upper half
            mirrored = 1.32 - 0.32 * min(1.0, 2 * (row - top) / height)
            draw.line((left, row, right, row), fill=painted(glass, mirrored, code))
        cloth = painted(CURTAINS[int(rng.integers(len(CURTAINS)))], code=code)
        if variant % 4 == 1:  # open curtains
            draw.rectangle((left, top, left + width // 4, bottom), fill=cloth)
            draw.rectangle((right - width // 4, top, right, bottom), fill=cloth)
        elif variant % 4 == 2:  # a blind
            draw.rectangle(
                (left, top, right, top + int(height * rng.uniform(0.3, 0.9))), fill=cloth
            )
        draw.rectangle((left, top, right, bottom), outline=frame, width=2)
        for x in np.linspace(left, right, bars_across + 2)[1:-1]:
            draw.line((x, top, x, bottom), fill=frame, width=2)
        for y in np.linspace(top, bottom, bars_up + 2)[1:-1]:
            draw.line((left, y, right, y), fill=frame)
        draw.rectangle(
            (left - edge, bottom + 1, right + edge, bottom + 3), fill=painted(trim, 1.06)
        )
        draw.line((left - edge, bottom + 4, right + edge, bottom + 4), fill=painted(trim, 0.5))
        if shutter:
            for x in (0, right + edge + 1):
                draw.rectangle((x, top, x + width // 2 - 1, bottom), fill=painted(shutter))
                for y in range(top + 3, bottom, 3):
                    draw.line((x + 2, y, x + width // 2 - 3, y), fill=painted(shutter, 0.8))
        if balcony:
            draw.line((0, bottom - 20, picture.width, bottom - 20), fill=(44, 46, 50, 255), width=2)
            for x in range(0, picture.width, 4):
                draw.line((x, bottom - 20, x, bottom), fill=(44, 46, 50, 255))
        windows.append(picture)
    return windows


def _draw_door(rng: np.random.Generator, colour: Colour) -> Image.Image:
    """Draw a door with its frame and a light above it."""
    width, height = _pixels(1.3), _pixels(2.6)
    picture = Image.new("RGBA", (width + 8, height + 4), painted((168, 162, 150)))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((4, 4, width + 3, height + 3), fill=painted(colour))
    pane = CODE_FIRST_PANE + int(rng.integers(PANE_CODES))
    draw.rectangle((6, 6, width + 1, height // 5), fill=painted(GLASS[0], code=pane))
    edges = np.linspace(height // 5 + 4, height, int(rng.integers(2, 5)))
    for top, bottom in zip(edges[:-1], edges[1:] - 3, strict=True):
        for x in (7, width // 2 + 5):
            draw.rectangle((x, top, x + width // 2 - 6, bottom), outline=painted(colour, 0.62))
    draw.line((width // 2 + 3, height // 5, width // 2 + 3, height), fill=painted(colour, 0.5))
    return picture


def _draw_sign(rng: np.random.Generator, colour: Colour) -> Image.Image:
    """Draw the sign of a shop with its name."""
    name = "".join(rng.choice(SYLLABLES.split(), int(rng.integers(2, 4)))).upper()
    font = ImageFont.load_default(size=15)
    board, ink = (colour, (244, 240, 228)) if rng.uniform() < 0.7 else ((238, 234, 222), colour)
    sign = Image.new("RGBA", (int(font.getlength(name)) + 16, 20), painted(board))
    letters = Image.new("L", sign.size)
    ImageDraw.Draw(letters).text((8, 1), name, fill=255, font=font)
    sign.paste(painted(ink, code=CODE_SIGN), mask=letters.point(lambda value: 255 * (value > 110)))
    return sign


def draw_house(
    rng: np.random.Generator, width_m: float, shopping: float, floors: int, style: HouseStyle
) -> Image.Image:
    """Draw a random house for a plot, from its chimneys to the pavement: RGBA with material codes.

    `shopping` is the probability that it has shops, `floors` the typical number in its row.
    """
    bays = max(1, round(width_m / rng.uniform(2.3, 3.3)))
    floors = int(np.clip(floors + rng.integers(-1, 2), 2, 5))
    ground, storey = rng.choice([3.3, 3.7, 4.2]), rng.choice([2.9, 3.1, 3.4])
    width, height = _pixels(width_m), _pixels(ground + (floors - 1) * storey + HEADROOM_M)
    eaves = _pixels(HEADROOM_M)
    picture = Image.new("RGBA", (width, height), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    trim = style.trims[int(rng.integers(len(style.trims)))]
    centres = [round((bay + 0.5) * width / bays) for bay in range(bays)]
    _draw_roof(draw, rng, centres, eaves, style, trim)
    _paste_wall(picture, rng, style, eaves)
    if rng.uniform() < 0.45:
        _paste_wall(picture, rng, style, height - _pixels(ground))
    windows = [style.windows[int(number)] for number in rng.integers(WINDOWS, size=2)]
    if rng.uniform() < 0.6:
        windows[1] = windows[0]
    blank = rng.uniform(size=bays) < (0.10 if bays > 2 else 0.0)
    courses = rng.uniform() < 0.5
    for floor in range(1, floors):
        foot = height - _pixels(ground + (floor - 1) * storey)
        if courses or floor == 1:
            draw.rectangle((0, foot - 4, width, foot), fill=painted(trim))
            draw.line((0, foot + 1, width, foot + 1), fill=painted(trim, 0.55))
        for x, is_blank in zip(centres, blank, strict=True):
            window = windows[floor == floors - 1][int(rng.integers(PANE_CODES))]
            if not is_blank:
                _paste(picture, window, x, foot - _pixels(0.7))
    _draw_ground_floor(picture, rng, centres, blank, shopping, style, windows[0])
    draw.rectangle((0, eaves - 4, width, eaves + 5), fill=painted(trim))  # the cornice
    draw.rectangle((0, eaves + 6, width, eaves + 9), fill=painted(trim, 0.5))
    draw.line((0, eaves, 0, height), fill=painted(trim, 0.5))
    return picture


def _draw_roof(
    draw: ImageDraw.ImageDraw,
    rng: np.random.Generator,
    centres: list[int],
    eaves: int,
    style: HouseStyle,
    trim: Colour,
) -> None:
    """Draw chimneys, and a low roof or a mansard with dormers, above the row `eaves`."""
    width = draw.im.size[0]
    colour = style.roofs[int(rng.integers(len(style.roofs)))]
    mansard = rng.uniform() < 0.3
    ridge = eaves - _pixels(2.2 if mansard else 0.6)
    for share in rng.uniform(0.05, 0.9, int(rng.integers(0, 4))):
        x = int(share * (width - 16))
        draw.rectangle((x, ridge - 15, x + 13, eaves), fill=painted((134, 92, 76)))
        draw.rectangle((x - 1, ridge - 15, x + 14, ridge - 12), fill=(96, 88, 84, CODE_FLAT))
    draw.rectangle((0, ridge, width, eaves), fill=(*colour, CODE_FLAT))
    if mansard:
        for y in range(ridge + 3, eaves, 4):
            draw.line((0, y, width, y), fill=painted(colour, 0.86, CODE_FLAT))
        for number, x in enumerate(centres):
            pane = CODE_FIRST_PANE + number % PANE_CODES
            draw.rectangle((x - 12, ridge + 8, x + 12, eaves), fill=painted(trim))
            draw.rectangle((x - 8, ridge + 13, x + 8, eaves - 3), fill=painted(GLASS[0], code=pane))


def _draw_ground_floor(
    picture: Image.Image,
    rng: np.random.Generator,
    centres: list[int],
    blank: np.ndarray[tuple[int], np.dtype[np.bool_]],
    shopping: float,
    style: HouseStyle,
    windows: list[Image.Image],
) -> None:
    """Draw a door, and shops or windows in the other bays."""
    draw = ImageDraw.Draw(picture)
    width, height = picture.size
    draw.rectangle((0, height - _pixels(0.35), width, height), fill=painted(style.trims[3], 0.8))
    door_bay, has_shops = int(rng.integers(len(centres))), rng.uniform() < shopping
    for bay, x in enumerate(centres):
        window = windows[int(rng.integers(PANE_CODES))]
        if bay == door_bay:
            _paste(picture, style.doors[int(rng.integers(DOORS))], x, height)
        elif has_shops and rng.uniform() < 0.8:
            half, base = int(width / len(centres) * 0.43), height - _pixels(0.4)
            top = base - _pixels(2.2)
            draw.rectangle((x - half, top, x + half, base), fill=painted(GLASS[2], code=CODE_SIGN))
            for goods in range(x - half + 3, x + half - 9, 12):
                colour = tuple(int(value) for value in rng.integers(60, 220, 3))
                wide, high = int(rng.integers(4, 11)), int(rng.integers(8, 30))
                box = (goods, base - 2 - high, goods + wide, base - 2)
                draw.rectangle(box, fill=(*colour, CODE_SIGN))
            draw.rectangle((x - half, top, x + half, base), outline=painted((40, 40, 42)), width=2)
            _paste(picture, style.signs[int(rng.integers(SHOPS))], x, top - 2)
        elif not blank[bay]:
            _paste(picture, window, x, height - _pixels(0.95))


def _paste_wall(
    picture: Image.Image, rng: np.random.Generator, style: HouseStyle, top: int
) -> None:
    """Fill a picture below the row `top` with one of the walls, which are seamless."""
    wall = style.walls[int(rng.integers(WALLS))]
    shift_x, shift_y = (int(shift) for shift in rng.integers(TILE_PIXELS, size=2))
    below = Image.new("RGBA", (picture.width, picture.height - top))
    for x in range(-shift_x, below.width, TILE_PIXELS):
        for y in range(-shift_y, below.height, TILE_PIXELS):
            below.paste(wall, (x, y))
    picture.paste(below, (0, top))


def _paste(picture: Image.Image, part: Image.Image, centre: int, foot: int) -> None:
    """Paste what is not transparent; `foot` is the row below the part."""
    mask = part.getchannel("A").point([0] + [255] * 255)
    picture.paste(part, (centre - part.width // 2, foot - part.height), mask)
