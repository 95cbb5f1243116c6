"""A house's facade as a texture: walls, openings and shops, from the eaves to the pavement."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from shared.datasets.city.catalogue import Catalogue
from shared.datasets.city.codes import CODE_FLAT, CODE_SHOP, CODE_SOLID, PANE_CODES
from shared.datasets.city.house import House, bay_centre_column
from shared.datasets.city.openings import darken, draw_shop_glass, metres_to_pixels
from shared.datasets.city.roofs import draw_eaves, draw_roof
from shared.datasets.city.walls import TILE_HEIGHT, TILE_WIDTH, Colour

ANY_CODE = [0] + [255] * 255
"""a table for `point`: 255 wherever something is"""


def draw_house(house: House, catalogue: Catalogue) -> Image.Image:
    """The facade from `top` down to the pavement, RGBA with codes, PIXELS_PER_METRE."""
    rng = np.random.default_rng(house.detail_seed)
    width, height = metres_to_pixels(house.width), metres_to_pixels(house.top)
    eaves = height - metres_to_pixels(house.eaves)
    picture = Image.new("RGBA", (width, height), (0, 0, 0, 0))
    trim = catalogue.trims[house.trim]
    draw_roof(picture, house, catalogue, eaves)
    _wall(picture, catalogue.walls[house.wall], (0, eaves, width, height), rng)
    ground = height - metres_to_pixels(house.ground_floor)
    if house.base_wall >= 0:
        _wall(picture, catalogue.walls[house.base_wall], (0, ground, width, height), rng)
    draw = ImageDraw.Draw(picture)
    if house.quoins:
        _quoins(draw, width, eaves, height, trim)
    _floors(picture, draw, house, catalogue, rng, trim)
    _street_level(picture, draw, house, catalogue, rng)
    draw.rectangle(
        (0, height - metres_to_pixels(0.35), width, height), fill=(*darken(trim, 0.62), CODE_SOLID)
    )
    _door(picture, house, catalogue)
    draw_eaves(draw, house, width, eaves, trim)
    draw.line((0, eaves, 0, height), fill=(*darken(trim, 0.5), CODE_SOLID))
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
        y = picture.height - metres_to_pixels(base)
        if house.string_courses or floor == 1:
            draw.rectangle((0, y - 4, picture.width, y), fill=(*trim, CODE_SOLID))
            draw.line((0, y + 1, picture.width, y + 1), fill=(*darken(trim, 0.55), CODE_SOLID))
        index = house.window if floor < house.floors - 1 else house.upper_window
        for bay in range(house.bays):
            if bay in house.blank_bays:
                continue
            sprite = catalogue.windows[index][int(rng.integers(PANE_CODES))]
            kind = catalogue.window_types[index]
            x = bay_centre_column(house, bay) - sprite.width // 2
            foot = 0.15 if kind.balcony else 0.85
            picture.paste(
                sprite, (x, y - metres_to_pixels(foot) - sprite.height + 4), _solid(sprite)
            )


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
        middle = bay_centre_column(house, bay)
        if bay == house.door_bay:
            continue
        shop = house.shops[bay]
        if shop >= 0:
            wide, high = metres_to_pixels(pitch * 0.86), metres_to_pixels(2.25)
            glass = draw_shop_glass(wide, high, rng)
            left, top = middle - wide // 2, height - metres_to_pixels(0.4) - high
            picture.paste(glass, (left, top))
            draw.rectangle(
                (left, top, left + wide, top + high), outline=(40, 40, 42, CODE_SOLID), width=2
            )
            sign = catalogue.signs[shop]
            if sign.width > wide:
                sign = sign.resize((wide, sign.height), Image.Resampling.NEAREST)
            draw.rectangle(
                (left, top - 24, left + wide, top - 2),
                fill=(*darken(catalogue.trims[2], 0.6), CODE_SOLID),
            )
            picture.paste(sign, (middle - sign.width // 2, top - 23))
            if house.awning >= 0:
                _awning(
                    draw,
                    (left - 3, top - 3, left + wide + 3, top + metres_to_pixels(0.62)),
                    catalogue.awnings[house.awning],
                )
        elif bay not in house.blank_bays:
            sprite = catalogue.windows[house.window][int(rng.integers(PANE_CODES))]
            y = height - metres_to_pixels(0.95) - sprite.height
            picture.paste(sprite, (middle - sprite.width // 2, y), _solid(sprite))


def _door(picture: Image.Image, house: House, catalogue: Catalogue) -> None:
    """The door reaches the pavement: it goes over the plinth."""
    door = catalogue.doors[house.door]
    x = bay_centre_column(house, house.door_bay) - door.width // 2
    picture.paste(door, (x, picture.height - door.height), _solid(door))


def _awning(
    draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], colours: tuple[Colour, Colour]
) -> None:
    left, top, right, bottom = box
    for i, x in enumerate(range(left, right, 7)):
        fill = (*colours[i % 2], CODE_FLAT)
        draw.rectangle((x, top, min(right, x + 6), bottom - 3), fill=fill)
        draw.pieslice((x, bottom - 7, min(right, x + 6), bottom), 0, 180, fill=fill)
    draw.line((left, top, right, top), fill=(*darken(colours[0], 1.3), CODE_FLAT))
    draw.line((left, bottom + 1, right, bottom + 1), fill=(30, 30, 32, CODE_SHOP), width=2)


def _quoins(draw: ImageDraw.ImageDraw, width: int, top: int, bottom: int, trim: Colour) -> None:
    for i, y in enumerate(range(top, bottom, 11)):
        long = 15 if i % 2 else 9
        for x0, x1 in ((0, long), (width - 1 - long, width - 1)):
            draw.rectangle((x0, y, x1, y + 9), fill=(*trim, CODE_SOLID))


def _solid(sprite: Image.Image) -> Image.Image:
    """The mask of a part: everything that is not see-through."""
    return sprite.getchannel("A").point(ANY_CODE)
