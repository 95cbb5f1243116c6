"""What stands in a street: trees, lamps, posts and boxes, as RGBA pictures with codes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from shared.datasets.city.codes import CODE_FLAT, CODE_LAMP, CODE_SOLID
from shared.datasets.city.openings import darken
from shared.datasets.city.walls import Colour

OBJECT_PIXELS_PER_METRE = 40
"""finer than facades: these come nearer"""

FOLIAGE = ("spring", "summer", "autumn", "bare")


@dataclass(frozen=True, slots=True)
class Sprite:
    """A flat picture with its size in metres; its lower edge is `bottom` above the ground."""

    image: Image.Image
    width: float
    height: float
    bottom: float = 0.0


def object_pixels(metres: float) -> int:
    """Metres as whole pixels of a thing's picture."""
    return round(metres * OBJECT_PIXELS_PER_METRE)


def draw_tree(
    height: float, crown: float, trunk: float, leaves: Colour, foliage: str, shape_seed: int
) -> Sprite:
    """A tree of `height` metres whose crown is `crown` wide and begins `trunk` above the ground.

    The same `shape_seed` gives the same tree in every foliage.
    """
    rng = np.random.default_rng(shape_seed)
    scale = OBJECT_PIXELS_PER_METRE * 3 // 4  # leaves need no finer picture
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
        fill=(*bark, CODE_SOLID),
    )
    crown_height = (height - trunk) * scale
    for _ in range(26):  # branches
        angle = rng.uniform(-1.15, 1.15)
        long = crown_height * rng.uniform(0.40, 0.85)
        start = fork - int(rng.uniform(0, 0.35) * crown_height)
        end = (middle + np.sin(angle) * long * 0.62, start - np.cos(angle) * long * 0.75)
        draw.line(
            (middle, start, *end), fill=(*darken(bark, rng.uniform(0.8, 1.2)), CODE_SOLID), width=2
        )
        for _ in range(3):
            twig = (end[0] + rng.normal(0, 0.10) * width, end[1] - rng.uniform(0, 0.14) * tall)
            draw.line((*end, *twig), fill=(*darken(bark, 1.1), CODE_SOLID), width=1)
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
        draw.ellipse((x - size, y - size * 0.8, x + size, y + size * 0.8), fill=(*tone, CODE_SOLID))
    return Sprite(picture, crown, height)


def draw_lamp(colour: Colour, height: float) -> Sprite:
    """A street lamp: a post with an arm on each side."""
    width, tall = object_pixels(1.6), object_pixels(height)
    picture = Image.new("RGBA", (width, tall), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    middle = width // 2
    draw.rectangle((middle - 2, 8, middle + 2, tall - 1), fill=(*colour, CODE_SOLID))
    draw.rectangle(
        (middle - 5, tall - 30, middle + 5, tall - 1), fill=(*darken(colour, 0.8), CODE_SOLID)
    )
    draw.line((8, 9, width - 9, 9), fill=(*colour, CODE_SOLID), width=3)
    for x in (8, width - 9):
        draw.rectangle((x - 7, 6, x + 7, 9), fill=(*darken(colour, 0.8), CODE_SOLID))
        draw.rectangle((x - 6, 10, x + 6, 14), fill=(248, 236, 200, CODE_LAMP))
    return Sprite(picture, 1.6, height)


def draw_post_sign(kind: int, rng: np.random.Generator) -> Sprite:
    """A traffic sign on its post."""
    width, tall = object_pixels(0.66), object_pixels(2.6)
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
    """A bin, a cabinet or a letter box."""
    picture = Image.new(
        "RGBA", (object_pixels(width), object_pixels(height)), (*colour, CODE_SOLID)
    )
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 0, picture.width - 1, 3), fill=(*darken(colour, 1.25), CODE_FLAT))
    draw.rectangle((3, 9, picture.width - 4, 14), fill=(*darken(colour, 0.5), CODE_SOLID))
    draw.rectangle(
        (0, picture.height - 4, picture.width - 1, picture.height - 1),
        fill=(30, 30, 32, CODE_SOLID),
    )
    return Sprite(picture, width, height)
