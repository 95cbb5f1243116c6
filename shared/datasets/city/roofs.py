"""Roofs and eaves: what a house has against the sky."""

from __future__ import annotations

from PIL import Image, ImageDraw

from shared.datasets.city.catalogue import Catalogue
from shared.datasets.city.codes import CODE_FLAT, CODE_SOLID, PANE_CODES
from shared.datasets.city.house import House, bay_centre_column
from shared.datasets.city.openings import darken, metres_to_pixels
from shared.datasets.city.walls import Colour


def draw_roof(picture: Image.Image, house: House, catalogue: Catalogue, eaves: int) -> None:
    draw = ImageDraw.Draw(picture)
    width = picture.width
    colour = catalogue.roofs[house.roof_colour]
    tiles = (*colour, CODE_FLAT)
    ridge = {"mansard": eaves - metres_to_pixels(2.3), "gable": eaves - metres_to_pixels(2.6)}.get(
        house.roof, eaves - metres_to_pixels(0.7)
    )
    for share in house.chimneys:
        x = int(share * (width - 16))
        draw.rectangle(
            (x, ridge - metres_to_pixels(0.7), x + 13, eaves), fill=(134, 92, 76, CODE_SOLID)
        )
        draw.rectangle(
            (x - 1, ridge - metres_to_pixels(0.7), x + 14, ridge - metres_to_pixels(0.7) + 3),
            fill=(96, 88, 84, CODE_FLAT),
        )
    if house.roof == "mansard":
        slope = metres_to_pixels(0.5)
        draw.polygon(
            [(0, eaves), (slope, ridge), (width - slope, ridge), (width, eaves)], fill=tiles
        )
        for y in range(ridge + 3, eaves, 4):
            draw.line((slope, y, width - slope, y), fill=(*darken(colour, 0.86), CODE_FLAT))
        for bay in range(house.bays):
            x = bay_centre_column(house, bay)
            draw.rectangle(
                (x - 12, ridge + 10, x + 12, eaves), fill=(*catalogue.trims[house.trim], CODE_SOLID)
            )
            draw.rectangle(
                (x - 8, ridge + 15, x + 8, eaves - 3), fill=(66, 80, 92, 1 + bay % PANE_CODES)
            )
            draw.polygon([(x - 15, ridge + 11), (x, ridge + 2), (x + 15, ridge + 11)], fill=tiles)
    elif house.roof == "gable":
        draw.polygon(
            [(0, eaves), (width // 2, ridge), (width, eaves)],
            fill=(*catalogue.wall_colours[house.wall], CODE_SOLID),
        )
        draw.line((0, eaves, width // 2, ridge), fill=tiles, width=7)
        draw.line((width // 2, ridge, width, eaves), fill=tiles, width=7)
        middle = (ridge + 2 * eaves) // 3
        draw.ellipse((width // 2 - 9, middle - 9, width // 2 + 9, middle + 9), fill=(62, 74, 86, 2))
    else:
        draw.rectangle((0, ridge + 6, width, eaves), fill=tiles)


def draw_eaves(
    draw: ImageDraw.ImageDraw, house: House, width: int, eaves: int, trim: Colour
) -> None:
    if house.roof == "gable":
        return
    if house.roof == "parapet":
        draw.rectangle(
            (0, eaves - metres_to_pixels(0.8), width, eaves), fill=(*darken(trim, 0.94), CODE_SOLID)
        )
        for x in range(4, width - 6, 14):
            draw.rectangle(
                (x, eaves - metres_to_pixels(0.6), x + 7, eaves - 5),
                fill=(*darken(trim, 0.7), CODE_SOLID),
            )
        draw.rectangle(
            (0, eaves - metres_to_pixels(0.85), width, eaves - metres_to_pixels(0.8) + 3),
            fill=(*trim, CODE_FLAT),
        )
        return
    draw.rectangle((0, eaves - 4, width, eaves + 5), fill=(*trim, CODE_SOLID))
    draw.rectangle((0, eaves + 6, width, eaves + 9), fill=(*darken(trim, 0.5), CODE_SOLID))
    for x in range(3, width, 12):  # brackets
        draw.rectangle((x, eaves + 6, x + 4, eaves + 11), fill=(*darken(trim, 0.85), CODE_SOLID))
