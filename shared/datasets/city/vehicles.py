"""Vehicles: bodies and paints that a city repeats, from the side, the end and above the bonnet."""

from __future__ import annotations

from dataclasses import dataclass

from PIL import Image, ImageDraw

from shared.datasets.city.codes import CODE_FLAT, CODE_LAMP, CODE_SOLID
from shared.datasets.city.openings import darken
from shared.datasets.city.street_things import OBJECT_PIXELS_PER_METRE, Sprite, object_pixels
from shared.datasets.city.walls import Colour


@dataclass(frozen=True, slots=True)
class VehicleShape:
    """One body, metres; the cabin runs between two shares of the length."""

    length: float
    height: float
    width: float
    bonnet: float
    """height of the bonnet"""
    cabin: tuple[float, float]
    slope: float
    """share of the length that a windscreen leans"""
    windows: int


VEHICLE_SHARES = (0.30, 0.25, 0.25, 0.15, 0.05)
"""of the shapes in traffic"""
VEHICLE_SHAPES = (
    VehicleShape(4.1, 1.48, 1.75, 0.92, (0.20, 0.96), 0.10, 2),  # hatchback
    VehicleShape(4.6, 1.44, 1.80, 0.90, (0.22, 0.84), 0.11, 2),  # saloon
    VehicleShape(4.7, 1.70, 1.90, 1.05, (0.20, 0.99), 0.07, 3),  # estate
    VehicleShape(5.3, 2.25, 2.00, 1.20, (0.10, 1.00), 0.07, 1),  # van
    VehicleShape(6.4, 2.90, 2.20, 2.60, (0.02, 0.24), 0.02, 1),  # box lorry
)


def draw_vehicle_side(shape: VehicleShape, paint: Colour) -> Sprite:
    """The vehicle from its side, nose to the left."""
    width, tall = object_pixels(shape.length), object_pixels(shape.height)
    picture = Image.new("RGBA", (width, tall + 2), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    low, bonnet = object_pixels(0.28), object_pixels(shape.bonnet)
    body, shade = (*paint, CODE_SOLID), (*darken(paint, 0.72), CODE_SOLID)
    front, back = (int(width * share) for share in shape.cabin)
    lean = int(width * shape.slope)
    draw.rectangle((2, tall - 4, width - 3, tall + 1), fill=(28, 28, 30, CODE_SOLID))  # its shadow
    draw.rounded_rectangle((0, tall - bonnet, width - 1, tall - low), radius=8, fill=body)
    draw.polygon(
        [
            (front, tall - bonnet + 2),
            (front + lean, 1),
            (back - lean, 1),
            (back, tall - bonnet + 2),
        ],
        fill=body,
    )
    draw.line((front + lean, 1, back - lean, 1), fill=(*darken(paint, 1.2), CODE_FLAT), width=3)
    draw.rectangle((1, tall - low - object_pixels(0.22), width - 2, tall - low), fill=shade)
    sill = tall - bonnet + 1 if shape.bonnet < 2 else tall - object_pixels(1.35)
    head = object_pixels(0.12)
    inner_front, inner_back = front + max(4, lean // 3), back - max(4, lean // 3)
    for pane in range(shape.windows):
        left = inner_front + pane * (inner_back - inner_front) // shape.windows + 2
        right = inner_front + (pane + 1) * (inner_back - inner_front) // shape.windows - 2
        upper_left = max(left, front + lean + 3)
        upper_right = min(right, back - lean - 3)
        if shape.length > 5 and pane == 0 and shape.bonnet < 2:
            right, upper_right = left + width // 5, left + width // 5
        draw.polygon(
            [(left, sill), (upper_left, head), (upper_right, head), (right, sill)],
            fill=(52, 62, 72, CODE_SOLID),
        )
        draw.line((upper_left, head + 2, upper_right, head + 2), fill=(120, 134, 144, CODE_SOLID))
    for share in (0.18, 0.80):
        _wheel(draw, int(width * share), tall - object_pixels(0.32), object_pixels(0.33))
    draw.rectangle((1, tall - bonnet + 6, 6, tall - bonnet + 14), fill=(236, 232, 210, CODE_LAMP))
    draw.rectangle(
        (width - 6, tall - bonnet + 6, width - 2, tall - bonnet + 14), fill=(170, 30, 28, CODE_LAMP)
    )
    draw.line((width // 2, sill, width // 2, tall - low), fill=shade)
    return Sprite(picture, shape.length, (tall + 2) / OBJECT_PIXELS_PER_METRE)


def _wheel(draw: ImageDraw.ImageDraw, x: int, y: int, radius: int) -> None:
    for share, colour in (
        (1.18, (30, 30, 32)),
        (1.0, (22, 22, 24)),
        (0.58, (150, 152, 154)),
        (0.2, (60, 60, 62)),
    ):
        r = int(radius * share)
        draw.ellipse((x - r, y - r, x + r, y + r), fill=(*colour, CODE_SOLID))


def draw_vehicle_end(shape: VehicleShape, paint: Colour, rear: bool) -> Sprite:
    """The body's nose or tail, up to the bonnet."""
    width, tall = object_pixels(shape.width), object_pixels(shape.bonnet)
    picture = Image.new("RGBA", (width, tall + 2), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((4, tall - 12, width - 5, tall + 1), fill=(24, 24, 26, CODE_SOLID))
    draw.rounded_rectangle((0, 0, width - 1, tall - 8), radius=5, fill=(*paint, CODE_SOLID))
    draw.line((4, 0, width - 5, 0), fill=(*darken(paint, 1.2), CODE_FLAT), width=2)
    draw.rectangle(
        (1, tall - object_pixels(0.5), width - 2, tall - 9), fill=(*darken(paint, 0.72), CODE_SOLID)
    )
    top = 6 if shape.bonnet < 2 else tall - object_pixels(0.9)
    lamp = (170, 30, 28, CODE_LAMP) if rear else (238, 234, 212, CODE_LAMP)
    for x in (3, width - 15):
        draw.rectangle((x, top, x + 11, top + 7), fill=lamp)
    if not rear:
        grille = (18, top + 1, width - 19, top + 7)
        draw.rectangle(grille, fill=(*darken(paint, 0.45), CODE_SOLID))
    plate = (
        width // 2 - 10,
        tall - object_pixels(0.45),
        width // 2 + 10,
        tall - object_pixels(0.45) + 5,
    )
    draw.rectangle(plate, fill=(226, 226, 220, CODE_SOLID))
    return Sprite(picture, shape.width, (tall + 2) / OBJECT_PIXELS_PER_METRE)


def draw_vehicle_screen(shape: VehicleShape, paint: Colour) -> Sprite:
    """The cabin's front or back above the bonnet; a little lower, so that no gap shows."""
    overlap = 0.14
    width, tall = object_pixels(shape.width), object_pixels(shape.height - shape.bonnet + overlap)
    picture = Image.new("RGBA", (width, tall), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    lean, hem = width // 11, object_pixels(overlap)
    outline = [(1, tall - 1), (lean, 0), (width - 1 - lean, 0), (width - 2, tall - 1)]
    draw.polygon(outline, fill=(*paint, CODE_SOLID))
    if tall > 3 * hem:
        glass = [(7, tall - hem), (lean + 4, 5), (width - 5 - lean, 5), (width - 8, tall - hem)]
        draw.polygon(glass, fill=(58, 68, 78, CODE_SOLID))
        draw.line((lean + 5, 7, width - 6 - lean, 7), fill=(128, 142, 152, CODE_SOLID), width=2)
    bottom = shape.bonnet - overlap
    return Sprite(picture, shape.width, tall / OBJECT_PIXELS_PER_METRE, bottom)
