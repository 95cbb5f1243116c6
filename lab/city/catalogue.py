"""Catalogue: the parts that all houses and streets of a city share.

A catalogue is a city's style: another seed gives other walls, colours, window types and trees. It
is small on purpose: a thousand places share its parts, so that no single part identifies a place.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lab.city.street_objects import (
    FOLIAGE,
    VEHICLE_SHAPES,
    Sprite,
    draw_box,
    draw_lamp,
    draw_post_sign,
    draw_tree,
    draw_vehicle_end,
    draw_vehicle_screen,
    draw_vehicle_side,
)
from lab.city.textures import (
    CODE_SIGN,
    CODE_SOLID,
    PANE_CODES,
    WALL_KINDS,
    Colour,
    WindowType,
    draw_door,
    draw_wall,
    draw_window,
    random_stream,
)

WALLS = 10
WINDOW_TYPES = 7
DOORS = 5
SHOPS = 16
TREES = 6
ACCENTS = 6
"""Colours of doors, signs and awnings"""
TRIMS = 4
ROOFS = 3
SYLLABLES = (
    "ba be bo ca da do el fa gi ko la li lo ma mi mo na ni no pa pe ra ri ro sa so ta ti to va zo"
)
VEHICLE_PAINTS: tuple[Colour, ...] = (
    (200, 202, 204),
    (38, 40, 44),
    (118, 122, 126),
    (150, 34, 32),
    (36, 60, 110),
    (226, 226, 222),
    (74, 84, 70),
)


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The drawn parts. The fourth channel of RGBA images holds the material codes of `textures`."""

    walls: tuple[Image.Image, ...]
    """RGB tiles"""
    wall_colours: tuple[Colour, ...]
    windows: tuple[tuple[Image.Image, ...], ...]
    """By type, then by variant"""
    window_types: tuple[WindowType, ...]
    doors: tuple[Image.Image, ...]
    signs: tuple[Image.Image, ...]
    """Shop signs with names"""
    blades: tuple[Sprite, ...]
    """Projecting shop signs"""
    awnings: tuple[tuple[Colour, Colour], ...]
    trims: tuple[Colour, ...]
    roofs: tuple[Colour, ...]
    trees: dict[str, tuple[Sprite, ...]]
    """By foliage"""
    vehicle_sides: tuple[Sprite, ...]
    vehicle_fronts: tuple[Sprite, ...]
    vehicle_rears: tuple[Sprite, ...]
    vehicle_screens: tuple[Sprite, ...]
    """The cabin's front and back"""
    cabins: tuple[tuple[float, float], ...]
    """Metres from the vehicle's front to the cabin's front and back"""
    lamps: tuple[Sprite, ...]
    posts: tuple[Sprite, ...]
    boxes: tuple[Sprite, ...]


def make_catalogue(seed: int) -> Catalogue:
    """Draw the catalogue of a seed."""
    rng = random_stream(seed, "catalogue")
    hue = rng.uniform(0.04, 0.16)  # hue of the city's stone, from pink through ochre to straw
    kinds = [WALL_KINDS[i] for i in rng.permutation(len(WALL_KINDS))]
    colours = [_wall_colour(rng, hue) for _ in range(WALLS)]
    walls = tuple(
        draw_wall(kinds[i % 5] if i % 2 else "plaster", colours[i], rng) for i in range(WALLS)
    )
    trims = tuple(_colour(hue, rng.uniform(0.04, 0.16), v) for v in (0.94, 0.86, 0.74, 0.58))
    window_types = tuple(_window_type(rng, trims) for _ in range(WINDOW_TYPES))
    accents = [
        _colour(rng.uniform(), rng.uniform(0.35, 0.75), rng.uniform(0.3, 0.7))
        for _ in range(ACCENTS)
    ]
    shapes = [
        (rng.uniform(5.5, 9.5), rng.uniform(3.2, 6.0), rng.uniform(2.0, 2.9)) for _ in range(TREES)
    ]
    leaf = _colour(rng.uniform(0.20, 0.29), rng.uniform(0.35, 0.5), rng.uniform(0.36, 0.48))
    vehicles = [(shape, paint) for shape in VEHICLE_SHAPES for paint in VEHICLE_PAINTS]
    iron = _colour(rng.uniform(), 0.25, 0.25)
    names = [
        "".join(rng.choice(SYLLABLES.split(), int(rng.integers(2, 4)))).upper()
        for _ in range(SHOPS)
    ]
    return Catalogue(
        walls=walls,
        wall_colours=tuple(colours),
        windows=tuple(
            tuple(draw_window(kind, variant, rng) for variant in range(PANE_CODES))
            for kind in window_types
        ),
        window_types=window_types,
        doors=tuple(
            draw_door(accents[i % len(accents)], int(rng.integers(1, 5)), i % 2 == 0, rng)
            for i in range(DOORS)
        ),
        signs=tuple(_sign(name, accents[i % len(accents)], i % 3) for i, name in enumerate(names)),
        blades=tuple(
            _blade(name, accents[(i + 2) % len(accents)]) for i, name in enumerate(names[:8])
        ),
        awnings=tuple((accents[i], trims[0] if i % 2 else accents[i]) for i in range(len(accents))),
        trims=trims,
        roofs=tuple(_colour(hue - 0.03, s, v) for s, v in ((0.5, 0.5), (0.1, 0.36), (0.2, 0.46))),
        trees={
            foliage: tuple(
                draw_tree(*shape, leaf, foliage, shape_seed=1000 * seed + i)
                for i, shape in enumerate(shapes)
            )
            for foliage in FOLIAGE
        },
        vehicle_sides=tuple(draw_vehicle_side(*vehicle) for vehicle in vehicles),
        vehicle_fronts=tuple(draw_vehicle_end(*vehicle, rear=False) for vehicle in vehicles),
        vehicle_rears=tuple(draw_vehicle_end(*vehicle, rear=True) for vehicle in vehicles),
        vehicle_screens=tuple(draw_vehicle_screen(*vehicle) for vehicle in vehicles),
        cabins=tuple(
            (
                shape.length * (shape.cabin[0] + shape.slope / 2),
                shape.length * (shape.cabin[1] - shape.slope / 2),
            )
            for shape, _ in vehicles
        ),
        lamps=(draw_lamp(iron, 5.5),),
        posts=tuple(draw_post_sign(i, rng) for i in range(4)),
        boxes=tuple(
            draw_box(colour, width, height)
            for colour, width, height in (
                (accents[0], 0.55, 1.0),
                ((96, 104, 98), 0.9, 1.25),
                (accents[3], 0.5, 1.4),
                ((60, 78, 62), 1.3, 1.2),
            )
        ),
    )


def _colour(hue: float, saturation: float, value: float) -> Colour:
    red, green, blue = colorsys.hsv_to_rgb(hue % 1, saturation, value)
    return int(red * 255), int(green * 255), int(blue * 255)


def _wall_colour(rng: np.random.Generator, hue: float) -> Colour:
    return _colour(hue + rng.normal(0, 0.025), rng.uniform(0.10, 0.42), rng.uniform(0.55, 0.88))


def _window_type(rng: np.random.Generator, trims: tuple[Colour, ...]) -> WindowType:
    dark = (52, 50, 48)
    shutter = _colour(rng.uniform(0.2, 0.6), 0.35, 0.42)
    return WindowType(
        width=float(rng.choice([0.95, 1.1, 1.25, 1.5, 1.8])),
        height=float(rng.choice([1.35, 1.6, 1.8, 2.0])),
        mullions=int(rng.integers(0, 3)),
        transoms=int(rng.integers(0, 3)),
        frame=(236, 234, 228) if rng.uniform() < 0.7 else dark,
        surround=trims[int(rng.integers(3))],
        surround_width=float(rng.choice([0.05, 0.12, 0.18])),
        arched=bool(rng.uniform() < 0.22),
        shutters=shutter if rng.uniform() < 0.3 else None,
        pediment=bool(rng.uniform() < 0.25),
        balcony=bool(rng.uniform() < 0.25),
    )


def _sign(name: str, colour: Colour, style: int) -> Image.Image:
    """Draw a shop sign of 20 pixels height, as wide as its name."""
    font = ImageFont.load_default(size=15)
    width = int(font.getlength(name)) + 16
    ground, ink = (colour, (244, 240, 228)) if style != 1 else ((238, 234, 222), colour)
    board = Image.new("RGBA", (width, 20), (*ground, CODE_SIGN if style == 2 else CODE_SOLID))
    draw = ImageDraw.Draw(board)
    mask = Image.new("L", board.size)
    ImageDraw.Draw(mask).text((8, 1), name, fill=255, font=font)
    board.paste(
        (*ink, CODE_SIGN), (0, 0, *board.size), mask.point(lambda value: 255 * (value > 110))
    )
    draw.rectangle(
        (0, 0, width - 1, 19), outline=(*tuple(int(c * 0.6) for c in ground), CODE_SOLID)
    )
    return board


def _blade(name: str, colour: Colour) -> Sprite:
    image = Image.new("RGBA", (32, 40), (*colour, CODE_SIGN))
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, 31, 39), outline=(240, 236, 226, CODE_SOLID), width=2)
    draw.text(
        (9, 6), name[0], fill=(244, 240, 230, CODE_SIGN), font=ImageFont.load_default(size=22)
    )
    return Sprite(image, 0.8, 1.0, bottom=3.1)
