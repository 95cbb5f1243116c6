"""Drawings of matches: the query beside each photo, with lines between the matching points."""

from __future__ import annotations

from collections.abc import Sequence

from PIL import Image, ImageColor, ImageDraw, ImageFont

from placewise.answers import PointPair
from shared.errors import PlacewiseError, Unprocessable
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing

GAP = 16  # pixels
CAPTION = 24  # height of a caption in pixels
MAX_LINES = 150  # of the most similar points; more hide the photos
BACKGROUND = "white"


def read_photo(data: bytes, name: str) -> Image.Image:
    """Return an upright copy whose longer side has at most 640 pixels.

    Raises:
        Unprocessable: `photo_not_drawable`.
    """
    try:
        decoded = decode_photo(data, get_preprocessing("square32"), 5 * 10**8, detection_channels=3)
    except PlacewiseError as error:
        raise photo_not_drawable_error(name, error) from error
    assert decoded.detection_pixels is not None
    return Image.fromarray(decoded.detection_pixels)


def photo_not_drawable_error(name: str, error: PlacewiseError) -> Unprocessable:
    """Return the error for a photo whose original can't be read."""
    return Unprocessable("photo_not_drawable", f"{name} can't be drawn: {error.detail}")


def draw_matches(
    query: Image.Image,
    photo: Image.Image,
    pairs: Sequence[PointPair],
    query_size: tuple[int, int],
    photo_size: tuple[int, int],
    caption: str,
) -> Image.Image:
    """Draw query and photo side by side, with lines between their matching points.

    Args:
        pairs: Most similar first; the first MAX_LINES are drawn.
        query_size: (width, height) that the points of the query refer to.
        photo_size: (width, height) that those of the photo refer to.
    """
    right = query.width + GAP
    drawn = Image.new(
        "RGB", (right + photo.width, CAPTION + max(query.height, photo.height)), BACKGROUND
    )
    drawn.paste(query, (0, CAPTION))
    drawn.paste(photo, (right, CAPTION))
    pen = ImageDraw.Draw(drawn)
    pen.text((2, 2), caption, "black", ImageFont.load_default(16))
    shown = pairs[:MAX_LINES]
    for number, pair in enumerate(shown):
        colour = ImageColor.getrgb(f"hsl({360 * number // len(shown)}, 90%, 50%)")
        begin, end = (
            (x + point[0] * image.width / size[0], CAPTION + point[1] * image.height / size[1])
            for x, point, image, size in (
                (0, pair.query, query, query_size),
                (right, pair.photo, photo, photo_size),
            )
        )
        pen.line((*begin, *end), colour)
        for x, y in (begin, end):
            pen.ellipse((x - 2, y - 2, x + 2, y + 2), outline=colour)
    return drawn


def stack(drawings: Sequence[Image.Image]) -> Image.Image:
    """Return the drawings below each other."""
    height = sum(drawing.height + GAP for drawing in drawings) - GAP
    sheet = Image.new("RGB", (max(drawing.width for drawing in drawings), height), BACKGROUND)
    top = 0
    for drawing in drawings:
        sheet.paste(drawing, (0, top))
        top += drawing.height + GAP
    return sheet
