"""Decoding: every accepted format, upright, at the right brightness, or refused with a reason."""

from __future__ import annotations

import io
import random
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.PngImagePlugin import PngInfo

from shared.errors import Unprocessable
from shared.imaging.decode import FULL_DECODE_PIXELS, THUMBNAIL_PIXELS, decode_photo
from shared.imaging.file_formats import Previews, detect_media_type
from shared.imaging.preprocessing import get_preprocessing
from tests.support.photos import encoded, photo_bytes, photo_image, turned_photo

SQUARE = get_preprocessing("square32")
PIXELS = 50_000_000


def mean_colour(data: bytes) -> tuple[int, int, int]:
    red, green, blue = decode_photo(data, SQUARE, PIXELS).pixels.reshape(-1, 3).mean(axis=0)
    return round(red), round(green), round(blue)


def reason(data: bytes, max_pixels: int = PIXELS) -> Unprocessable:
    with pytest.raises(Unprocessable) as caught:
        decode_photo(data, SQUARE, max_pixels)
    return caught.value


def multi_picture() -> bytes:
    """What phones write under the name JPEG."""
    return encoded(photo_image(1), "MPO", save_all=True, append_images=[photo_image(2)])


FORMATS: dict[str, bytes] = {
    "JPEG": photo_bytes(1),
    "progressive JPEG": photo_bytes(1, progressive=True),
    "MPO": multi_picture(),
    "PNG": photo_bytes(1, "PNG"),
    "WebP": photo_bytes(1, "WEBP", quality=95),
    "lossless WebP": photo_bytes(1, "WEBP", lossless=True),
    "BMP": photo_bytes(1, "BMP"),
    "TIFF": photo_bytes(1, "TIFF"),
    "LZW TIFF": photo_bytes(1, "TIFF", compression="tiff_lzw"),
    "JPEG TIFF": photo_bytes(1, "TIFF", compression="jpeg"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_accepted_format_decodes_to_the_size_of_the_preprocessing(name: str) -> None:
    decoded = decode_photo(FORMATS[name], SQUARE, PIXELS)
    assert decoded.pixels.shape == (32, 32, 3)
    assert decoded.pixels.dtype == np.uint8
    expected = SQUARE.apply(photo_image(1)).astype(float)
    assert np.abs(decoded.pixels - expected).mean() < 12, "these are not the photo's pixels"
    assert detect_media_type(FORMATS[name][:16]) is not None


@pytest.mark.parametrize("media", ["PNG", "BMP", "TIFF"])
@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_lossless_formats_keep_every_pixel(media: str, mode: str) -> None:
    decoded = decode_photo(encoded(photo_image(3).convert(mode), media), SQUARE, PIXELS)
    np.testing.assert_array_equal(decoded.pixels, SQUARE.apply(photo_image(3)))


def corners(pixels: Any) -> list[str]:
    """The colours of the four corners, clockwise from the top left."""
    names = {(1, 0, 0): "red", (0, 1, 0): "green", (0, 0, 1): "blue", (1, 1, 0): "yellow"}
    found = [pixels[2, 2], pixels[2, -3], pixels[-3, -3], pixels[-3, 2]]
    return [names[tuple(int(v > 128) for v in colour)] for colour in found]  # type: ignore[index]


@pytest.mark.parametrize(
    ("orientation", "media"),
    [*((number, "JPEG") for number in range(1, 9)), (6, "PNG"), (6, "WEBP"), (6, "TIFF")],
)
def test_every_exif_orientation_comes_out_upright(orientation: int, media: str) -> None:
    upright = Image.new("RGB", (48, 32), (255, 0, 0))
    upright.paste((0, 255, 0), (24, 0, 48, 16))
    upright.paste((0, 0, 255), (24, 16, 48, 32))
    upright.paste((255, 255, 0), (0, 16, 24, 32))
    decoded = decode_photo(turned_photo(upright, orientation, media), SQUARE, PIXELS)
    assert corners(decoded.pixels) == ["red", "green", "blue", "yellow"]
    thumbnail = Image.open(io.BytesIO(decoded.thumbnail))
    assert thumbnail.size == (48, 32)
    assert corners(np.asarray(thumbnail)) == ["red", "green", "blue", "yellow"]


@pytest.mark.parametrize("media", ["JPEG", "WEBP", "PNG", "TIFF"])
def test_an_orientation_in_xmp_turns_no_photo_as_in_browsers(media: str) -> None:
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/" tiff:Orientation="6"/>'
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp.decode())
    by_media: dict[str, Any] = {"PNG": {"pnginfo": text}, "TIFF": {"tiffinfo": {700: xmp}}}
    data = encoded(Image.new("RGB", (48, 32)), media, **by_media.get(media, {"xmp": xmp}))
    decoded = decode_photo(data, SQUARE, PIXELS)
    assert decoded.size == Image.open(io.BytesIO(decoded.thumbnail)).size == (48, 32)


@pytest.mark.parametrize("name", ["demo1024", "paper480x640", "round14"])
def test_published_preprocessings_ignore_the_exif_orientation(name: str) -> None:
    published = get_preprocessing(name)
    on_its_side = turned_photo(photo_image(1), 6, "PNG")
    decoded = decode_photo(on_its_side, published, PIXELS)
    as_stored = photo_image(1).transpose(Image.Transpose.ROTATE_90)
    np.testing.assert_array_equal(decoded.pixels, published.apply(as_stored))
    assert Image.open(io.BytesIO(decoded.thumbnail)).size == (64, 48), "thumbnails are upright"


@pytest.mark.parametrize("media", ["PNG", "TIFF"])
def test_16_bit_grey_is_scaled_and_not_clipped_to_white(media: str) -> None:
    samples = np.full((20, 30), 0x8000, dtype=np.uint16)
    assert mean_colour(encoded(Image.fromarray(samples), media)) == (128, 128, 128)


def png16(samples: NDArray[np.uint16]) -> bytes:
    """A PNG of 16-bit samples (H, W, 3), which Pillow reads but can't write."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    height, width = samples.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    lines = samples.astype(">u2").reshape(height, -1)
    body = zlib.compress(b"".join(b"\0" + line.tobytes() for line in lines))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    )


def test_16_bit_colours_keep_their_upper_eight_bits() -> None:
    eight = np.asarray(photo_image(3))
    below = np.random.default_rng(0).integers(0, 256, eight.shape, dtype=np.uint16)
    data = png16(eight.astype(np.uint16) * np.uint16(256) + below)
    decoded = decode_photo(data, SQUARE, PIXELS)
    np.testing.assert_array_equal(decoded.pixels, SQUARE.apply(photo_image(3)))


def test_cmyk_jpeg_has_its_colours() -> None:
    red = Image.new("RGB", (40, 40), (220, 30, 30)).convert("CMYK")
    r, g, b = mean_colour(encoded(red, "JPEG", quality=95))
    assert abs(r - 220) < 8
    assert abs(g - 30) < 8
    assert abs(b - 30) < 8


def test_palette_with_transparency_has_the_colours_of_its_palette_on_black() -> None:
    image = Image.new("P", (16, 16), 1)
    image.putpalette([0, 0, 0, 10, 200, 90])
    assert mean_colour(encoded(image, "PNG", transparency=0)) == (10, 200, 90)
    assert mean_colour(encoded(image, "PNG", transparency=bytes([255, 128]))) == (5, 100, 45)
    assert mean_colour(encoded(image, "PNG", transparency=1)) == (0, 0, 0)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (Image.new("RGBA", (8, 8), (200, 100, 50, 0)), (0, 0, 0)),
        (Image.new("RGBA", (8, 8), (200, 100, 50, 51)), (40, 20, 10)),
        (Image.new("LA", (8, 8), (250, 51)), (50, 50, 50)),
    ],
)
def test_transparent_parts_show_black_whatever_lies_under_them(
    image: Image.Image, expected: tuple[int, int, int]
) -> None:
    for media in ("PNG", "WEBP", "TIFF"):
        assert mean_colour(encoded(image, media, lossless=True)) == expected


@pytest.mark.parametrize(
    ("mode", "colour", "expected"),
    [
        ("1", 1, (255, 255, 255)),
        ("L", 77, (77, 77, 77)),
        ("LA", (77, 255), (77, 77, 77)),
        ("RGBA", (9, 8, 7, 255), (9, 8, 7)),
    ],
)
@pytest.mark.parametrize("side", [1, 10])
def test_other_pixel_modes_become_rgb(
    mode: str, colour: Any, expected: tuple[int, int, int], side: int
) -> None:
    data = encoded(Image.new(mode, (side, side), colour), "PNG")
    decoded = decode_photo(data, SQUARE, PIXELS)
    assert set(map(tuple, decoded.pixels.reshape(-1, 3).tolist())) == {expected}
    assert Image.open(io.BytesIO(decoded.thumbnail)).size == (side, side)


def test_animated_webp_shows_its_first_frame() -> None:
    frames = [Image.new("RGB", (20, 20), colour) for colour in ("#ff0000", "#00ff00", "#0000ff")]
    data = encoded(frames[0], "WEBP", save_all=True, append_images=frames[1:], lossless=True)
    assert mean_colour(data) == (255, 0, 0)


@pytest.mark.parametrize("media", ["JPEG", "PNG", "WEBP", "BMP", "TIFF"])
def test_truncated_photo_is_an_error_and_not_a_grey_picture(media: str) -> None:
    whole = photo_bytes(1, media)
    assert reason(whole[: len(whole) * 2 // 3]).code == "undecodable_photo"


def test_a_file_that_is_no_photo_raises_an_error_that_lists_the_accepted_formats() -> None:
    others = [photo_bytes(1, media) for media in ("GIF", "PPM", "TGA")]
    for data in (b"", b"this is a text\n" * 40, *others):
        assert reason(data).code == "undecodable_photo"
        assert "not JPEG, PNG, WebP, BMP, TIFF or HEIC" in reason(data).detail
    cut_off = reason(b"\xff\xd8\xff\xe0")
    assert cut_off.code == "undecodable_photo"
    assert "its header is cut off" in cut_off.detail
    depth = Image.fromarray(np.full((20, 30), 1.5, dtype=np.float32))
    assert "brightness range" in reason(encoded(depth, "TIFF")).detail


def test_too_many_pixels_are_an_error_that_names_the_limit() -> None:
    error = reason(photo_bytes(1, "PNG"), max_pixels=64 * 48 - 1)
    assert error.code == "too_many_pixels"
    assert "64 x 48" in error.detail
    assert str(64 * 48 - 1) in error.detail
    decode_photo(photo_bytes(1, "PNG"), SQUARE, max_pixels=64 * 48)


def test_working_copy_is_small_and_upright_and_the_size_is_that_of_the_upright_photo() -> None:
    data = turned_photo(Image.new("RGB", (6000, 8400)), 6, "JPEG")
    assert FULL_DECODE_PIXELS < 6000 * 8400, "it is decoded at half its size"
    decoded = decode_photo(data, SQUARE, 10**9, for_detection=True)
    assert decoded.size == (6000, 8400)
    assert decoded.detection_pixels is not None
    assert decoded.detection_pixels.shape == (640, 457, 1)
    assert decode_photo(photo_bytes(1), SQUARE, PIXELS).detection_pixels is None


def test_detection_pixels_are_the_mean_of_rgb_up_to_rounding() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    data = encoded(Image.fromarray(noise), "PNG")
    gray = np.array(decode_photo(data, SQUARE, 10**9, for_detection=True).detection_pixels)
    assert gray.shape == (480, 640, 1)
    np.testing.assert_allclose(gray, noise.mean(axis=2, keepdims=True), atol=1)


def private_exif() -> Image.Exif:
    exif = Image.Exif()
    exif[Base.Make] = "SecretCamera"
    exif.get_ifd(IFD.GPSInfo)[GPS.GPSLatitudeRef] = "N"
    exif.get_ifd(IFD.GPSInfo)[GPS.GPSLatitude] = (45.0, 4.0, 12.5)
    return exif


@pytest.mark.parametrize("media", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_thumbnails_and_previews_are_upright_and_carry_nothing_that_the_camera_wrote(
    media: str,
) -> None:
    exif = private_exif()
    exif[Base.Orientation] = 6
    options: dict[str, Any] = {"exif": exif}
    if media == "JPEG":
        options |= {"comment": b"SecretComment", "dpi": (72, 72), "xmp": b"<x>SecretXmp</x>"}
    data = encoded(photo_image(1, 2000, 1000), media, **options)
    decoded = decode_photo(data, SQUARE, PIXELS, previews=Previews.ALL)
    assert decoded.preview is not None
    assert b"Secret" in data
    half = THUMBNAIL_PIXELS // 2
    for made, size in (
        (decoded.thumbnail, (half, THUMBNAIL_PIXELS)),
        (decoded.preview, (800, 1600)),
    ):
        assert b"Secret" not in made
        assert b"Exif" not in made
        with Image.open(io.BytesIO(made)) as image:
            assert (image.format, image.size) == ("JPEG", size)
            assert len(image.getexif()) == 0


@pytest.mark.parametrize(
    ("media", "size", "preview_size", "of_other_formats"),
    [
        ("JPEG", (1601, 800), (1600, 800), False),
        ("JPEG", (1600, 800), None, False),
        ("PNG", (800, 2000), (640, 1600), False),
        ("TIFF", (64, 48), (64, 48), True),
        ("BMP", (64, 48), (64, 48), True),
        ("WEBP", (64, 48), None, False),
    ],
)
def test_photos_that_are_large_or_that_browsers_do_not_show_get_a_preview(
    media: str,
    size: tuple[int, int],
    preview_size: tuple[int, int] | None,
    of_other_formats: bool,
) -> None:
    data = encoded(Image.new("RGB", size, (1, 2, 3)), media)
    preview = decode_photo(data, SQUARE, PIXELS, previews=Previews.ALL).preview
    assert decode_photo(data, SQUARE, PIXELS).preview is None
    small_set = decode_photo(data, SQUARE, PIXELS, previews=Previews.OTHER_FORMATS)
    assert (small_set.preview is not None) is of_other_formats
    if preview_size is None:
        assert preview is None
    else:
        assert preview is not None
        with Image.open(io.BytesIO(preview)) as image:
            assert (image.format, image.size) == ("JPEG", preview_size)


def test_photos_with_broken_exif_are_decoded() -> None:
    """A tag of text that holds a fraction: Pillow reads it, but can't write it again."""
    entry = struct.pack("<HHIHHII", 1, 0x010F, 0, 0, 0, 0, 0)
    for exif in (
        b"Exif\0\0nonsense",
        b"Exif\0\0II*\0\x08\0\0\0" + entry,
        b"Exif\0\0II*\0\xff\xff\xff\xff",
        b"Exif\0\0II*\0\x08\0\0\0\x01\0\x0f\x01\x05\0\x01\0\0\0\x08\0\0\0\0\0\0\0",
    ):
        data = encoded(photo_image(1), "JPEG", exif=exif)
        assert decode_photo(data, SQUARE, PIXELS).pixels.shape == (32, 32, 3)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), media=st.sampled_from(sorted(FORMATS)))
def test_damaged_photos_decode_or_are_refused_and_raise_nothing_else(seed: int, media: str) -> None:
    rng = random.Random(seed)
    data = bytearray(FORMATS[media])
    for _ in range(rng.choice([1, 3, 10])):
        data[rng.randrange(len(data))] = rng.randrange(256)
    try:
        decode_photo(bytes(data), SQUARE, 1_000_000)
    except Unprocessable as error:
        assert error.code in ("undecodable_photo", "too_many_pixels")  # noqa: PT017
