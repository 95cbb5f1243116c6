"""What stands in the streets: trees, lamps, cabinets and vehicles, as textured parallelograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from lab.city.camera import Floats
from lab.city.raster import Quad, Texture
from lab.city.textures import CODE_FLAT, CODE_LAMP, Colour, colour_of, painted, random_stream

PIXELS_PER_METRE = 40
FOLIAGE = ("spring", "summer", "autumn", "bare")
TREES = 4
LAMP_M = 5.5
PAINTS: tuple[Colour, ...] = (
    (200, 202, 204), (38, 40, 44), (118, 122, 126), (150, 34, 32), (36, 60, 110), (226, 226, 222),
    (74, 84, 70),
)  # fmt: skip
GLASS = painted((52, 62, 72))
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class VehicleShape:
    """A vehicle body, in metres."""

    length: float
    width: float
    height: float
    bonnet: float
    """Height of the bonnet"""
    cabin: tuple[float, float]
    """Begin and end of its roof, from the front"""
    slope: float
    """Length of each windscreen"""


VEHICLE_SHAPES = (
    VehicleShape(4.3, 1.75, 1.48, 0.92, (1.3, 3.7), 0.5),  # car
    VehicleShape(4.7, 1.90, 1.70, 1.05, (1.3, 4.5), 0.35),  # estate
    VehicleShape(5.3, 2.00, 2.25, 1.20, (0.9, 5.2), 0.35),  # van
    VehicleShape(6.4, 2.20, 2.90, 2.60, (0.3, 1.6), 0.10),  # box lorry
)
VEHICLE_SHARES = (0.50, 0.28, 0.17, 0.05)


@dataclass(frozen=True, slots=True)
class Sprite:
    """A texture with its size in metres."""

    texture: Texture
    width: float
    height: float

    def crossed(self, foot: Floats, heading: Floats) -> list[Quad]:
        """Stand two of it, crossed, on a (3,) point; `heading`: (3,) unit vector of the first."""
        aside = np.array([-heading[1], heading[0], 0.0])
        return [
            Quad(
                foot - axis * self.width / 2 + UP * self.height,
                axis * self.width,
                -UP * self.height,
                self.texture,
            )
            for axis in (heading, aside)
        ]


@dataclass(frozen=True, slots=True)
class Vehicle:
    """The textures of a vehicle."""

    shape: VehicleShape
    side: Texture
    ends: tuple[Texture, Texture]
    """Front and rear, up to the bonnet"""
    screen: Texture
    top: Texture

    def quads(self, middle: Floats, heading: Floats) -> list[Quad]:
        """Return the vehicle at (3,) the middle of its ground; `heading`: (3,) unit vector."""
        shape = self.shape
        left = np.array([-heading[1], heading[0], 0.0]) * shape.width
        front = middle + heading * shape.length / 2 + left / 2
        tall, bonnet = UP * shape.height, UP * shape.bonnet
        begin, end = (front - heading * metres for metres in shape.cabin)
        slope, back = heading * shape.slope, heading * shape.length
        return [
            Quad(front + tall, -back, -tall, self.side),
            Quad(front - left + tall, -back, -tall, self.side),
            Quad(front - left + bonnet, left, -bonnet, self.ends[0]),
            Quad(front - back + bonnet, -left, -bonnet, self.ends[1]),
            Quad(front + bonnet, -back, -left, self.top, 1.0),
            Quad(begin + tall, end - begin, -left, self.top, 1.0),
            Quad(begin - left + tall, left, bonnet - tall + slope, self.screen),
            Quad(end + tall, -left, bonnet - tall - slope, self.screen),
        ]


@dataclass(frozen=True, slots=True)
class ObjectStyle:
    """The objects of a city."""

    trees: dict[str, list[Sprite]]
    """By foliage"""
    lamp: Sprite
    cabinets: list[Sprite]
    vehicles: list[list[Vehicle]]
    """By shape, then by paint"""


def make_object_style(seed: int) -> ObjectStyle:
    """Draw the objects of a seed."""
    rng = random_stream(seed, "objects")
    leaf = colour_of(rng.uniform(0.20, 0.29), rng.uniform(0.35, 0.5), rng.uniform(0.36, 0.48))
    iron = colour_of(rng.uniform(), 0.25, 0.25)
    accent = colour_of(rng.uniform(), 0.5, 0.45)
    return ObjectStyle(
        trees={
            foliage: [_draw_tree((seed, "tree", number), leaf, foliage) for number in range(TREES)]
            for foliage in FOLIAGE
        },
        lamp=_draw_lamp(iron),
        cabinets=[
            _draw_cabinet(colour, width, height)
            for colour, width, height in (
                (accent, 0.55, 1.0), ((96, 104, 98), 0.9, 1.25), ((60, 78, 62), 1.3, 1.2),
            )
        ],
        vehicles=[[_draw_vehicle(shape, paint) for paint in PAINTS] for shape in VEHICLE_SHAPES],
    )  # fmt: skip


def _new_sprite(width: float, height: float) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    size = round(width * PIXELS_PER_METRE), round(height * PIXELS_PER_METRE)
    picture = Image.new("RGBA", size, (0, 0, 0, 0))
    return picture, ImageDraw.Draw(picture)


def _draw_tree(stream: tuple[int | str, ...], leaf: Colour, foliage: str) -> Sprite:
    """Draw a tree, which has the same branches in every foliage."""
    rng = random_stream(*stream)
    height, crown, trunk = rng.uniform(5.5, 9.5), rng.uniform(3.2, 6.0), rng.uniform(2.0, 2.9)
    picture, draw = _new_sprite(crown, height)
    (width, tall), bark = picture.size, (78, 66, 54)
    middle, fork = width // 2, tall - round(trunk * PIXELS_PER_METRE)
    draw.rectangle((middle - 5, fork - 10, middle + 5, tall), fill=painted(bark))
    for _ in range(60):
        start, angle = fork - rng.uniform(0, 0.35) * fork, rng.normal(0, 0.55)
        long = fork * rng.uniform(0.3, 0.6)
        end = (middle + np.sin(angle) * long * 0.8, start - np.cos(angle) * long)
        draw.line((middle, start, *end), fill=painted(bark, rng.uniform(0.8, 1.2)), width=3)
    tone = {"spring": (leaf[0] + 40, leaf[1] + 34, leaf[2] + 8), "autumn": (176, 118, 52)}
    for _ in range({"bare": 0, "summer": 2200}.get(foliage, 1300)):
        angle, radius = rng.uniform(0, 2 * np.pi), 0.46 * np.sqrt(rng.uniform())
        x = middle + np.cos(angle) * radius * width * rng.uniform(0.8, 1.0)
        y = fork * (0.55 + np.sin(angle) * radius)
        size = rng.uniform(3, 7)
        lit = np.clip(1.25 - 0.7 * y / fork + rng.normal(0, 0.13), 0.42, 1.4)
        draw.ellipse(
            (x - size, y - size, x + size, y + size), fill=painted(tone.get(foliage, leaf), lit)
        )
    return Sprite(Texture(picture), crown, height)


def _draw_lamp(colour: Colour) -> Sprite:
    picture, draw = _new_sprite(1.6, LAMP_M)
    width, tall = picture.size
    draw.rectangle((width // 2 - 2, 8, width // 2 + 2, tall), fill=painted(colour))
    draw.rectangle((width // 2 - 5, tall - 30, width // 2 + 5, tall), fill=painted(colour, 0.8))
    draw.line((8, 9, width - 9, 9), fill=painted(colour), width=3)
    for x in (8, width - 9):
        draw.rectangle((x - 6, 10, x + 6, 14), fill=(248, 236, 200, CODE_LAMP))
    return Sprite(Texture(picture), 1.6, LAMP_M)


def _draw_cabinet(colour: Colour, width: float, height: float) -> Sprite:
    picture, draw = _new_sprite(width, height)
    draw.rectangle((0, 0, *picture.size), fill=painted(colour))
    draw.rectangle((0, 0, picture.width, 3), fill=painted(colour, 1.25, CODE_FLAT))
    draw.rectangle((3, 9, picture.width - 4, 14), fill=painted(colour, 0.5))
    return Sprite(Texture(picture), width, height)


def _draw_vehicle(shape: VehicleShape, paint: Colour) -> Vehicle:
    """Draw the sides of a vehicle; its front is on the left."""
    picture, draw = _new_sprite(shape.length, shape.height)
    width, tall = picture.size
    bonnet, sill = (tall - round(m * PIXELS_PER_METRE) for m in (shape.bonnet, 0.28))
    begin, end, slope = (round(m * PIXELS_PER_METRE) for m in (*shape.cabin, shape.slope))
    outline = [(begin - slope, bonnet), (begin, 0), (end, 0), (end + slope, bonnet)]
    draw.rectangle((0, bonnet, width, sill), fill=painted(paint))
    draw.rectangle((0, sill - 9, width, sill), fill=painted(paint, 0.72))
    draw.polygon(outline, fill=painted(paint))
    glass_foot = max(bonnet, 6) if shape.bonnet < 2 else tall - 54
    middle = (begin + end) // 2
    for left, right in ((begin, middle - 2), (middle + 2, end)):
        if shape.height < 2 or left == begin:
            draw.rectangle((left + 2, 6, min(right, left + 60) - 2, glass_foot), fill=GLASS)
    for x in (0.18 * width, 0.80 * width):
        for radius, colour in ((13, (22, 22, 24)), (7, (150, 152, 154))):
            draw.ellipse(
                (x - radius, tall - 13 - radius, x + radius, tall - 13 + radius),
                fill=painted(colour),
            )
    draw.rectangle((0, bonnet + 6, 6, bonnet + 14), fill=(236, 232, 210, CODE_LAMP))
    draw.rectangle((width - 6, bonnet + 6, width, bonnet + 14), fill=(170, 30, 28, CODE_LAMP))
    side = Texture(picture)
    ends = []
    for lamp in ((238, 234, 212, CODE_LAMP), (170, 30, 28, CODE_LAMP)):
        picture, draw = _new_sprite(shape.width, shape.bonnet)
        width, tall = picture.size
        draw.rectangle((0, 0, width, tall - 9), fill=painted(paint))
        draw.rectangle((0, tall - 22, width, tall - 9), fill=painted(paint, 0.6))
        for x in (3, width - 15):
            draw.rectangle((x, tall - 30, x + 11, tall - 23), fill=lamp)
        draw.rectangle(
            (width // 2 - 10, tall - 20, width // 2 + 10, tall - 15), fill=painted((226, 226, 220))
        )
        ends.append(Texture(picture))
    picture, draw = _new_sprite(shape.width, max(0.3, shape.height - shape.bonnet))
    draw.rectangle((0, 0, *picture.size), fill=painted(paint))
    if shape.bonnet < 2:
        draw.rectangle((6, 5, picture.width - 7, picture.height - 3), fill=GLASS)
    screen = Texture(picture)
    top = Texture(Image.new("RGBA", (8, 8), painted(paint, 1.1, CODE_FLAT)))
    return Vehicle(shape, side, (ends[0], ends[1]), screen, top)
