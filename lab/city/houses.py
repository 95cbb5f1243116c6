"""Houses: the arrangement of catalogue parts, and the facade texture drawn from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from lab.city.catalogue import (
    ACCENTS,
    DOORS,
    ROOFS,
    SHOPS,
    TRIMS,
    WALLS,
    WINDOW_TYPES,
    Catalogue,
)
from lab.city.textures import (
    CODE_FLAT,
    CODE_SHOP,
    CODE_SOLID,
    PANE_CODES,
    PIXELS_PER_METRE,
    TILE_HEIGHT,
    TILE_WIDTH,
    Colour,
    draw_shop_glass,
    painted,
    to_pixels,
)

HEADROOM = 3.6
"""Metres above the eaves for roof, gable and chimneys; partly transparent in the texture"""


@dataclass(frozen=True, slots=True)
class House:
    """The arrangement of one house; metres, and indices into the catalogue."""

    width: float
    floors: int
    ground_floor: float
    """Height of the ground floor"""
    storey: float
    """Height of every floor above it"""
    wall: int
    base_wall: int
    window: int
    upper_window: int
    bays: int
    blank_bays: tuple[int, ...]
    """Bays without windows"""
    door_bay: int
    door: int
    shops: tuple[int, ...]
    """Sign of each bay's shop, -1 for none"""
    awning: int
    trim: int
    roof: str
    roof_colour: int
    chimneys: tuple[float, ...]
    string_courses: bool
    quoins: bool
    drainpipe: float
    detail_seed: int

    @property
    def eaves(self) -> float:
        """Height of the eaves."""
        return self.ground_floor + (self.floors - 1) * self.storey

    @property
    def top(self) -> float:
        """Height of the texture's upper edge."""
        return self.eaves + HEADROOM

    @property
    def pixels(self) -> int:
        """Number of pixels of the texture."""
        return to_pixels(self.width) * to_pixels(self.top)


def arrange_house(rng: np.random.Generator, width: float, shopping: float, floors: int) -> House:
    """Arrange a random house for a plot `width` metres wide.

    `shopping`: probability that the house has shops; `floors`: typical number of floors.
    """
    bays = max(1, round(width / rng.uniform(2.3, 3.3)))
    has_shops = rng.uniform() < shopping
    shops = tuple(
        int(rng.integers(SHOPS)) if has_shops and rng.uniform() < 0.8 else -1 for _ in range(bays)
    )
    window = int(rng.integers(WINDOW_TYPES))
    blank = tuple(int(b) for b in range(bays) if bays > 2 and rng.uniform() < 0.10)
    return House(
        width=width,
        floors=int(np.clip(floors + rng.integers(-1, 2), 2, 5)),
        ground_floor=float(rng.choice([3.3, 3.7, 4.2])),
        storey=float(rng.choice([2.9, 3.1, 3.4])),
        wall=int(rng.integers(WALLS)),
        base_wall=int(rng.integers(WALLS)) if rng.uniform() < 0.45 else -1,
        window=window,
        upper_window=window if rng.uniform() < 0.6 else int(rng.integers(WINDOW_TYPES)),
        bays=bays,
        blank_bays=blank,
        door_bay=int(rng.integers(bays)),
        door=int(rng.integers(DOORS)),
        shops=shops,
        awning=int(rng.integers(ACCENTS)) if rng.uniform() < 0.6 else -1,
        trim=int(rng.integers(TRIMS)),
        roof=str(rng.choice(["cornice", "cornice", "mansard", "gable", "parapet"])),
        roof_colour=int(rng.integers(ROOFS)),
        chimneys=tuple(float(x) for x in rng.uniform(0.05, 0.9, int(rng.integers(0, 4)))),
        string_courses=bool(rng.uniform() < 0.5),
        quoins=bool(rng.uniform() < 0.3),
        drainpipe=float(rng.choice([-1.0, 0.02, 0.98])),
        detail_seed=int(rng.integers(2**31)),
    )


def _bay_centre_column(house: House, bay: int) -> int:
    """Return the texture column of the centre of a bay."""
    return round((bay + 0.5) * house.width / house.bays * PIXELS_PER_METRE)


def _draw_roof(picture: Image.Image, house: House, catalogue: Catalogue, eaves: int) -> None:
    """Draw the roof and chimneys above row `eaves`."""
    draw = ImageDraw.Draw(picture)
    width = picture.width
    colour = catalogue.roofs[house.roof_colour]
    tiles = (*colour, CODE_FLAT)
    ridge = {"mansard": eaves - to_pixels(2.3), "gable": eaves - to_pixels(2.6)}.get(
        house.roof, eaves - to_pixels(0.7)
    )
    for share in house.chimneys:
        x = int(share * (width - 16))
        draw.rectangle((x, ridge - to_pixels(0.7), x + 13, eaves), fill=(134, 92, 76, CODE_SOLID))
        draw.rectangle(
            (x - 1, ridge - to_pixels(0.7), x + 14, ridge - to_pixels(0.7) + 3),
            fill=(96, 88, 84, CODE_FLAT),
        )
    if house.roof == "mansard":
        slope = to_pixels(0.5)
        draw.polygon(
            [(0, eaves), (slope, ridge), (width - slope, ridge), (width, eaves)], fill=tiles
        )
        for y in range(ridge + 3, eaves, 4):
            draw.line((slope, y, width - slope, y), fill=painted(colour, 0.86, CODE_FLAT))
        for bay in range(house.bays):
            x = _bay_centre_column(house, bay)
            draw.rectangle(
                (x - 12, ridge + 10, x + 12, eaves), fill=painted(catalogue.trims[house.trim])
            )
            draw.rectangle(
                (x - 8, ridge + 15, x + 8, eaves - 3), fill=(66, 80, 92, 1 + bay % PANE_CODES)
            )
            draw.polygon([(x - 15, ridge + 11), (x, ridge + 2), (x + 15, ridge + 11)], fill=tiles)
    elif house.roof == "gable":
        draw.polygon(
            [(0, eaves), (width // 2, ridge), (width, eaves)],
            fill=painted(catalogue.wall_colours[house.wall]),
        )
        draw.line((0, eaves, width // 2, ridge), fill=tiles, width=7)
        draw.line((width // 2, ridge, width, eaves), fill=tiles, width=7)
        middle = (ridge + 2 * eaves) // 3
        draw.ellipse((width // 2 - 9, middle - 9, width // 2 + 9, middle + 9), fill=(62, 74, 86, 2))
    else:
        draw.rectangle((0, ridge + 6, width, eaves), fill=tiles)


def _draw_eaves(
    draw: ImageDraw.ImageDraw, house: House, width: int, eaves: int, trim: Colour
) -> None:
    """Draw the cornice or parapet at row `eaves`."""
    if house.roof == "gable":
        return
    if house.roof == "parapet":
        draw.rectangle((0, eaves - to_pixels(0.8), width, eaves), fill=painted(trim, 0.94))
        for x in range(4, width - 6, 14):
            draw.rectangle(
                (x, eaves - to_pixels(0.6), x + 7, eaves - 5),
                fill=painted(trim, 0.7),
            )
        draw.rectangle(
            (0, eaves - to_pixels(0.85), width, eaves - to_pixels(0.8) + 3),
            fill=(*trim, CODE_FLAT),
        )
        return
    draw.rectangle((0, eaves - 4, width, eaves + 5), fill=painted(trim))
    draw.rectangle((0, eaves + 6, width, eaves + 9), fill=painted(trim, 0.5))
    for x in range(3, width, 12):  # brackets
        draw.rectangle((x, eaves + 6, x + 4, eaves + 11), fill=painted(trim, 0.85))


ANY_CODE = [0] + [255] * 255
"""Lookup table for `Image.point`: 255 for all codes but transparent"""


def draw_house(house: House, catalogue: Catalogue) -> Image.Image:
    """Draw the facade from `top` to the pavement, RGBA with material codes."""
    rng = np.random.default_rng(house.detail_seed)
    width, height = to_pixels(house.width), to_pixels(house.top)
    eaves = height - to_pixels(house.eaves)
    picture = Image.new("RGBA", (width, height), (0, 0, 0, 0))
    trim = catalogue.trims[house.trim]
    _draw_roof(picture, house, catalogue, eaves)
    _wall(picture, catalogue.walls[house.wall], (0, eaves, width, height), rng)
    ground = height - to_pixels(house.ground_floor)
    if house.base_wall >= 0:
        _wall(picture, catalogue.walls[house.base_wall], (0, ground, width, height), rng)
    draw = ImageDraw.Draw(picture)
    if house.quoins:
        _quoins(draw, width, eaves, height, trim)
    _floors(picture, draw, house, catalogue, rng, trim)
    _street_level(picture, draw, house, catalogue, rng)
    draw.rectangle((0, height - to_pixels(0.35), width, height), fill=painted(trim, 0.62))
    _door(picture, house, catalogue)
    _draw_eaves(draw, house, width, eaves, trim)
    draw.line((0, eaves, 0, height), fill=painted(trim, 0.5))
    if house.drainpipe >= 0:
        x = int(house.drainpipe * (width - 3))
        draw.line((x, eaves, x, height), fill=(86, 88, 90, CODE_SOLID), width=2)
    return picture


def _wall(
    picture: Image.Image,
    tile: Image.Image,
    box: tuple[int, int, int, int],
    rng: np.random.Generator,
) -> None:
    left, top, right, bottom = box
    x = int(rng.integers(max(1, TILE_WIDTH - (right - left))))
    y = int(rng.integers(max(1, TILE_HEIGHT - (bottom - top))))
    piece = tile.crop((x, y, x + right - left, y + bottom - top)).convert("RGBA")
    picture.paste(piece, (left, top))


def _floors(
    picture: Image.Image,
    draw: ImageDraw.ImageDraw,
    house: House,
    catalogue: Catalogue,
    rng: np.random.Generator,
    trim: Colour,
) -> None:
    for floor in range(1, house.floors):
        base = house.ground_floor + (floor - 1) * house.storey
        y = picture.height - to_pixels(base)
        if house.string_courses or floor == 1:
            draw.rectangle((0, y - 4, picture.width, y), fill=painted(trim))
            draw.line((0, y + 1, picture.width, y + 1), fill=painted(trim, 0.55))
        index = house.window if floor < house.floors - 1 else house.upper_window
        for bay in range(house.bays):
            if bay in house.blank_bays:
                continue
            sprite = catalogue.windows[index][int(rng.integers(PANE_CODES))]
            kind = catalogue.window_types[index]
            x = _bay_centre_column(house, bay) - sprite.width // 2
            foot = 0.15 if kind.balcony else 0.85
            picture.paste(sprite, (x, y - to_pixels(foot) - sprite.height + 4), _solid(sprite))


def _street_level(
    picture: Image.Image,
    draw: ImageDraw.ImageDraw,
    house: House,
    catalogue: Catalogue,
    rng: np.random.Generator,
) -> None:
    height = picture.height
    pitch = house.width / house.bays
    for bay in range(house.bays):
        middle = _bay_centre_column(house, bay)
        if bay == house.door_bay:
            continue
        shop = house.shops[bay]
        if shop >= 0:
            wide, high = to_pixels(pitch * 0.86), to_pixels(2.25)
            glass = draw_shop_glass(wide, high, rng)
            left, top = middle - wide // 2, height - to_pixels(0.4) - high
            picture.paste(glass, (left, top))
            draw.rectangle(
                (left, top, left + wide, top + high), outline=(40, 40, 42, CODE_SOLID), width=2
            )
            sign = catalogue.signs[shop]
            if sign.width > wide:
                sign = sign.resize((wide, sign.height), Image.Resampling.NEAREST)
            draw.rectangle(
                (left, top - 24, left + wide, top - 2),
                fill=painted(catalogue.trims[2], 0.6),
            )
            picture.paste(sign, (middle - sign.width // 2, top - 23))
            if house.awning >= 0:
                _awning(
                    draw,
                    (left - 3, top - 3, left + wide + 3, top + to_pixels(0.62)),
                    catalogue.awnings[house.awning],
                )
        elif bay not in house.blank_bays:
            sprite = catalogue.windows[house.window][int(rng.integers(PANE_CODES))]
            y = height - to_pixels(0.95) - sprite.height
            picture.paste(sprite, (middle - sprite.width // 2, y), _solid(sprite))


def _door(picture: Image.Image, house: House, catalogue: Catalogue) -> None:
    """Draw the door over the plinth, down to the pavement."""
    door = catalogue.doors[house.door]
    x = _bay_centre_column(house, house.door_bay) - door.width // 2
    picture.paste(door, (x, picture.height - door.height), _solid(door))


def _awning(
    draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], colours: tuple[Colour, Colour]
) -> None:
    left, top, right, bottom = box
    for i, x in enumerate(range(left, right, 7)):
        fill = (*colours[i % 2], CODE_FLAT)
        draw.rectangle((x, top, min(right, x + 6), bottom - 3), fill=fill)
        draw.pieslice((x, bottom - 7, min(right, x + 6), bottom), 0, 180, fill=fill)
    draw.line((left, top, right, top), fill=painted(colours[0], 1.3, CODE_FLAT))
    draw.line((left, bottom + 1, right, bottom + 1), fill=(30, 30, 32, CODE_SHOP), width=2)


def _quoins(draw: ImageDraw.ImageDraw, width: int, top: int, bottom: int, trim: Colour) -> None:
    for i, y in enumerate(range(top, bottom, 11)):
        long = 15 if i % 2 else 9
        for x0, x1 in ((0, long), (width - 1 - long, width - 1)):
            draw.rectangle((x0, y, x1, y + 9), fill=painted(trim))


def _solid(sprite: Image.Image) -> Image.Image:
    """Return the mask of the pixels that are not transparent."""
    return sprite.getchannel("A").point(ANY_CODE)
