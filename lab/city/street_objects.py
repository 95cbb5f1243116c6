"""Sprites of street objects and vehicles: RGBA images with material codes in the fourth channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from lab.city.textures import CODE_FLAT, CODE_LAMP, CODE_SOLID, Colour, darken, painted

OBJECT_PIXELS_PER_METRE = 40
"""Finer than facades, because these come closer to the camera"""

FOLIAGE = ("spring", "summer", "autumn", "bare")


@dataclass(frozen=True, slots=True)
class Sprite:
    """A flat image with its size in metres; its lower edge is `bottom` above the ground."""

    image: Image.Image
    width: float
    height: float
    bottom: float = 0.0


def _object_pixels(metres: float) -> int:
    """Convert metres to pixels of a sprite."""
    return round(metres * OBJECT_PIXELS_PER_METRE)


def draw_tree(
    height: float, crown: float, trunk: float, leaves: Colour, foliage: str, shape_seed: int
) -> Sprite:
    """Draw a tree of `height` metres; its crown is `crown` wide and begins at height `trunk`.

    The same `shape_seed` gives the same tree in every foliage.
    """
    rng = np.random.default_rng(shape_seed)
    scale = OBJECT_PIXELS_PER_METRE * 3 // 4  # leaves need less resolution
    width, tall = round(crown * scale), round(height * scale)
    picture = Image.new("RGBA", (width, tall), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    bark = (78, 66, 54)
    middle, ground = width // 2, tall - 1
    fork = ground - round(trunk * scale)
    thick = max(2, round(0.16 * scale))
    draw.polygon(
        [
            (middle - thick, ground),
            (middle + thick, ground),
            (middle + thick // 2, fork - 10),
            (middle - thick // 2, fork - 10),
        ],
        fill=painted(bark),
    )
    crown_height = (height - trunk) * scale
    for _ in range(26):  # branches
        angle = rng.uniform(-1.15, 1.15)
        long = crown_height * rng.uniform(0.40, 0.85)
        start = fork - int(rng.uniform(0, 0.35) * crown_height)
        end = (middle + np.sin(angle) * long * 0.62, start - np.cos(angle) * long * 0.75)
        draw.line((middle, start, *end), fill=painted(bark, rng.uniform(0.8, 1.2)), width=2)
        for _ in range(3):
            twig = (end[0] + rng.normal(0, 0.10) * width, end[1] - rng.uniform(0, 0.14) * tall)
            draw.line((*end, *twig), fill=painted(bark, 1.1), width=1)
    if foliage == "bare":
        return Sprite(picture, crown, height)
    tones = {
        "summer": leaves,
        "spring": darken((leaves[0] + 26, leaves[1] + 22, leaves[2]), 1.12),
        "autumn": ((176, 118, 52), (150, 84, 48), (178, 148, 70))[shape_seed % 3],
    }
    density = {"spring": 1300, "summer": 2200, "autumn": 1300}[foliage]
    limbs = [
        (rng.uniform(-0.26, 0.26), rng.uniform(-0.34, 0.30), rng.uniform(0.26, 0.38))
        for _ in range(7)
    ] + [(0.0, 0.0, 0.44)]
    for leaf in range(density):
        across, up, reach = limbs[leaf % len(limbs)]
        angle, radius = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 1)) * reach
        x = middle + (across + np.cos(angle) * radius) * width * 0.86
        y = fork - crown_height * (0.47 + (up + np.sin(angle) * radius) * 0.72)
        size = rng.uniform(0.08, 0.18) * scale
        lit = 0.70 + 0.45 * (fork - y) / max(1.0, crown_height) + rng.normal(0, 0.13)
        tone = darken(tones[foliage], float(np.clip(lit, 0.42, 1.4)))
        draw.ellipse((x - size, y - size * 0.8, x + size, y + size * 0.8), fill=painted(tone))
    return Sprite(picture, crown, height)


def draw_lamp(colour: Colour, height: float) -> Sprite:
    """Draw a street lamp: a post with an arm on each side."""
    width, tall = _object_pixels(1.6), _object_pixels(height)
    picture = Image.new("RGBA", (width, tall), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    middle = width // 2
    draw.rectangle((middle - 2, 8, middle + 2, tall - 1), fill=painted(colour))
    draw.rectangle((middle - 5, tall - 30, middle + 5, tall - 1), fill=painted(colour, 0.8))
    draw.line((8, 9, width - 9, 9), fill=painted(colour), width=3)
    for x in (8, width - 9):
        draw.rectangle((x - 7, 6, x + 7, 9), fill=painted(colour, 0.8))
        draw.rectangle((x - 6, 10, x + 6, 14), fill=(248, 236, 200, CODE_LAMP))
    return Sprite(picture, 1.6, height)


def draw_post_sign(kind: int, rng: np.random.Generator) -> Sprite:
    """Draw a traffic sign on its post."""
    width, tall = _object_pixels(0.66), _object_pixels(2.6)
    picture = Image.new("RGBA", (width, tall), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    middle = width // 2
    draw.rectangle((middle - 1, 8, middle + 1, tall - 1), fill=(140, 142, 144, CODE_SOLID))
    face = (0, 0, width - 1, width - 1)
    if kind % 4 == 0:
        draw.ellipse(face, fill=(196, 40, 38, CODE_SOLID))
        draw.rectangle((5, middle - 3, width - 6, middle + 3), fill=(240, 240, 240, CODE_SOLID))
    elif kind % 4 == 1:
        draw.polygon([(0, 0), (width - 1, 0), (middle, width - 1)], fill=(200, 44, 40, CODE_SOLID))
        draw.polygon(
            [(5, 3), (width - 6, 3), (middle, width - 8)], fill=(244, 244, 240, CODE_SOLID)
        )
    elif kind % 4 == 2:
        draw.rectangle(face, fill=(36, 84, 168, CODE_SOLID))
        draw.rectangle((middle - 4, 5, middle + 4, width - 6), fill=(240, 240, 240, CODE_SOLID))
    else:
        draw.ellipse(face, fill=(36, 84, 168, CODE_SOLID))
        draw.line((5, width - 6, width - 6, 5), fill=(200, 44, 40, CODE_SOLID), width=4)
    if rng.uniform() < 0.5:
        draw.rectangle((2, width + 2, width - 3, width + 10), fill=(238, 238, 234, CODE_SOLID))
    return Sprite(picture, 0.66, 2.6)


def draw_box(colour: Colour, width: float, height: float) -> Sprite:
    """Draw a bin, a cabinet or a letter box."""
    picture = Image.new("RGBA", (_object_pixels(width), _object_pixels(height)), painted(colour))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 0, picture.width - 1, 3), fill=painted(colour, 1.25, CODE_FLAT))
    draw.rectangle((3, 9, picture.width - 4, 14), fill=painted(colour, 0.5))
    draw.rectangle(
        (0, picture.height - 4, picture.width - 1, picture.height - 1),
        fill=(30, 30, 32, CODE_SOLID),
    )
    return Sprite(picture, width, height)


@dataclass(frozen=True, slots=True)
class VehicleShape:
    """A vehicle body, in metres; `cabin` is a range in fractions of the length."""

    length: float
    height: float
    width: float
    bonnet: float
    """Height of the bonnet"""
    cabin: tuple[float, float]
    slope: float
    """Horizontal extent of a windscreen, as a fraction of the length"""
    windows: int


VEHICLE_SHARES = (0.30, 0.25, 0.25, 0.15, 0.05)
"""Frequencies of the shapes"""
VEHICLE_SHAPES = (
    VehicleShape(4.1, 1.48, 1.75, 0.92, (0.20, 0.96), 0.10, 2),  # hatchback
    VehicleShape(4.6, 1.44, 1.80, 0.90, (0.22, 0.84), 0.11, 2),  # saloon
    VehicleShape(4.7, 1.70, 1.90, 1.05, (0.20, 0.99), 0.07, 3),  # estate
    VehicleShape(5.3, 2.25, 2.00, 1.20, (0.10, 1.00), 0.07, 1),  # van
    VehicleShape(6.4, 2.90, 2.20, 2.60, (0.02, 0.24), 0.02, 1),  # box lorry
)


def draw_vehicle_side(shape: VehicleShape, paint: Colour) -> Sprite:
    """Draw a vehicle from its left side, front to the left."""
    width, tall = _object_pixels(shape.length), _object_pixels(shape.height)
    picture = Image.new("RGBA", (width, tall + 2), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    low, bonnet = _object_pixels(0.28), _object_pixels(shape.bonnet)
    body, shade = painted(paint), painted(paint, 0.72)
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
    draw.line((front + lean, 1, back - lean, 1), fill=painted(paint, 1.2, CODE_FLAT), width=3)
    draw.rectangle((1, tall - low - _object_pixels(0.22), width - 2, tall - low), fill=shade)
    sill = tall - bonnet + 1 if shape.bonnet < 2 else tall - _object_pixels(1.35)
    head = _object_pixels(0.12)
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
        _wheel(draw, int(width * share), tall - _object_pixels(0.32), _object_pixels(0.33))
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
        draw.ellipse((x - r, y - r, x + r, y + r), fill=painted(colour))


def draw_vehicle_end(shape: VehicleShape, paint: Colour, rear: bool) -> Sprite:
    """Draw the front or rear of the body, up to the bonnet."""
    width, tall = _object_pixels(shape.width), _object_pixels(shape.bonnet)
    picture = Image.new("RGBA", (width, tall + 2), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((4, tall - 12, width - 5, tall + 1), fill=(24, 24, 26, CODE_SOLID))
    draw.rounded_rectangle((0, 0, width - 1, tall - 8), radius=5, fill=painted(paint))
    draw.line((4, 0, width - 5, 0), fill=painted(paint, 1.2, CODE_FLAT), width=2)
    draw.rectangle(
        (1, tall - _object_pixels(0.5), width - 2, tall - 9),
        fill=painted(paint, 0.72),
    )
    top = 6 if shape.bonnet < 2 else tall - _object_pixels(0.9)
    lamp = (170, 30, 28, CODE_LAMP) if rear else (238, 234, 212, CODE_LAMP)
    for x in (3, width - 15):
        draw.rectangle((x, top, x + 11, top + 7), fill=lamp)
    if not rear:
        grille = (18, top + 1, width - 19, top + 7)
        draw.rectangle(grille, fill=painted(paint, 0.45))
    plate = (
        width // 2 - 10,
        tall - _object_pixels(0.45),
        width // 2 + 10,
        tall - _object_pixels(0.45) + 5,
    )
    draw.rectangle(plate, fill=(226, 226, 220, CODE_SOLID))
    return Sprite(picture, shape.width, (tall + 2) / OBJECT_PIXELS_PER_METRE)


def draw_vehicle_screen(shape: VehicleShape, paint: Colour) -> Sprite:
    """Draw the cabin's front or back above the bonnet, with an overlap to avoid a gap."""
    overlap = 0.14
    width, tall = _object_pixels(shape.width), _object_pixels(shape.height - shape.bonnet + overlap)
    picture = Image.new("RGBA", (width, tall), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    lean, hem = width // 11, _object_pixels(overlap)
    outline = [(1, tall - 1), (lean, 0), (width - 1 - lean, 0), (width - 2, tall - 1)]
    draw.polygon(outline, fill=painted(paint))
    if tall > 3 * hem:
        glass = [(7, tall - hem), (lean + 4, 5), (width - 5 - lean, 5), (width - 8, tall - hem)]
        draw.polygon(glass, fill=(58, 68, 78, CODE_SOLID))
        draw.line((lean + 5, 7, width - 6 - lean, 7), fill=(128, 142, 152, CODE_SOLID), width=2)
    bottom = shape.bonnet - overlap
    return Sprite(picture, shape.width, tall / OBJECT_PIXELS_PER_METRE, bottom)
