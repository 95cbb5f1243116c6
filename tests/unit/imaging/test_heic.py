"""HEIC: its header is read without its decoder, its pixels only in the decoding child."""

from __future__ import annotations

import builtins
import io
import random
import struct
from typing import Any

import numpy as np
import pillow_heif
import pytest
from PIL import Image
from PIL.ExifTags import Base

from shared.errors import Unprocessable
from shared.imaging.decode import THUMBNAIL_PIXELS, decode_photo
from shared.imaging.file_formats import detect_media_type
from shared.imaging.photo_header import read_photo_header
from shared.imaging.preprocessing import get_preprocessing
from tests.support import hostile_headers
from tests.support.photos import exif_with_position, photo_image

PIXELS = 50_000_000
SQUARE = get_preprocessing("square32")


def heic(image: Image.Image, **options: Any) -> bytes:
    buffer = io.BytesIO()
    pillow_heif.from_pillow(image).save(buffer, quality=95, **options)
    return buffer.getvalue()


IN_TURIN: bytes = exif_with_position(45.07, 7.69).tobytes()
PHOTO = heic(photo_image(1, 320, 200), exif=IN_TURIN)


@pytest.fixture
def no_decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "pillow_heif":
            raise ModuleNotFoundError(name)
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)


def test_heic_is_known_by_its_content() -> None:
    assert detect_media_type(PHOTO[:16]) == "image/heic"
    assert detect_media_type(b"\0\0\0\x20ftypavif\0\0\0\0") is None
    assert detect_media_type(b"\0\0\0\x20ftypisom\0\0\0\0") is None


def test_header_says_size_and_place_and_refuses_too_many_pixels_without_the_decoder(
    no_decoder: None,
) -> None:
    header = read_photo_header(io.BytesIO(PHOTO), PIXELS)
    assert (header.width, header.height) == (320, 200)
    assert header.latitude == pytest.approx(45.07)
    assert header.longitude == pytest.approx(7.69)
    with pytest.raises(Unprocessable) as caught:
        read_photo_header(io.BytesIO(PHOTO), 320 * 200 - 1)
    assert caught.value.code == "too_many_pixels"


@pytest.mark.parametrize("orientation", range(1, 9))
def test_header_and_decoder_agree_on_what_is_upright(orientation: int) -> None:
    image = photo_image(2, 96, 64)
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    data = heic(image, exif=exif.tobytes())
    header = read_photo_header(io.BytesIO(data), PIXELS)
    with Image.open(io.BytesIO(decode_photo(data, SQUARE, PIXELS).thumbnail)) as thumbnail:
        assert (header.width > header.height) == (thumbnail.width > thumbnail.height)
    assert pillow_heif.open_heif(io.BytesIO(data)).size == (header.width, header.height)


def test_pixels_and_thumbnail_are_those_of_the_photo_unless_it_is_cut_off() -> None:
    decoded = decode_photo(PHOTO, SQUARE, PIXELS)
    expected = SQUARE.apply(photo_image(1, 320, 200)).astype(float)
    assert np.abs(decoded.pixels - expected).mean() < 12
    with Image.open(io.BytesIO(decoded.thumbnail)) as thumbnail:
        assert thumbnail.format == "JPEG"
        assert max(thumbnail.size) == THUMBNAIL_PIXELS
        assert not thumbnail.getexif()
    for share in (0.3, 0.9):
        with pytest.raises(Unprocessable) as caught:
            decode_photo(PHOTO[: int(len(PHOTO) * share)], SQUARE, PIXELS)
        assert caught.value.code == "undecodable_photo"


def test_an_extractor_without_the_decoder_says_what_to_install(no_decoder: None) -> None:
    with pytest.raises(Unprocessable) as caught:
        decode_photo(PHOTO, SQUARE, PIXELS)
    assert caught.value.code == "no_heic_decoder"
    assert "uv pip install '.[heic]'" in caught.value.detail


def with_box_of(size: int) -> bytes:
    """A file of one box that says to be so large."""
    return hostile_headers.box(b"ftyp", b"heic\0\0\0\0") + struct.pack(">I4sQ", 1, b"free", size)


AVIF = PHOTO.replace(b"ftypheic", b"ftypmif1").replace(b"hvc1", b"av01")


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (AVIF, ""),
        *((with_box_of(size), "") for size in (2**63, 2**64 - 1)),
        *(
            (
                hostile_headers.heic(bytes(100), sizes=sizes),
                "its box iloc has fields of size zero",
            )
            for sizes in (b"\x40\0", b"\x04\0", b"\0\0")
        ),
    ],
    ids=["AVIF", "2^63", "2^64-1", "offset", "length", "both"],
)
def test_a_file_with_a_heic_signature_and_no_photo_is_refused(data: bytes, why: str) -> None:
    assert detect_media_type(data[:16]) == "image/heic"
    with pytest.raises(Unprocessable) as caught:
        read_photo_header(io.BytesIO(data), PIXELS)
    assert caught.value.code == "undecodable_photo"
    assert why in caught.value.detail


def test_exif_behind_an_item_of_several_extents_is_read_and_so_is_exif_in_several() -> None:
    exif = b"\0\0\0\6" + IN_TURIN
    at = 1000
    iloc = struct.pack(">HHH", 1, 0, 3) + bytes(24) + struct.pack(">HHHII", 2, 0, 1, at, len(exif))
    data = hostile_headers.heic(iloc, entries=2).ljust(at, b"\0") + exif
    header = read_photo_header(io.BytesIO(data), PIXELS)
    assert (header.width, header.height) == (320, 200)
    assert header.latitude == pytest.approx(45.07)
    parts = struct.pack(">HHHIIII", 2, 0, 2, at, 100, at + 200, len(exif) - 100)
    data = hostile_headers.heic(parts).ljust(at, b"\0") + exif[:100] + bytes(100) + exif[100:]
    assert read_photo_header(io.BytesIO(data), PIXELS).latitude == pytest.approx(45.07)
    elsewhere = hostile_headers.heic(struct.pack(">HHHII", 2, 7, 1, at, len(exif))) + data[-1000:]
    error = "its EXIF is damaged, or larger than 1 MB"
    assert read_photo_header(io.BytesIO(elsewhere), PIXELS).gps_error == error


def test_a_damaged_heic_header_is_read_or_refused() -> None:
    """Each byte that is wrong, and each length at which a file may end."""
    rng = random.Random(1)
    end = PHOTO.index(b"mdat") + 64
    for _ in range(3000):
        data = bytearray(PHOTO)
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(12, end)] = rng.randrange(256)
        try:
            header = read_photo_header(io.BytesIO(bytes(data)), PIXELS)
        except Unprocessable as error:
            assert error.code in ("undecodable_photo", "too_many_pixels")  # noqa: PT017
        else:
            assert 0 < header.width * header.height <= PIXELS
    for size in range(16, end):
        try:
            read_photo_header(io.BytesIO(PHOTO[:size]), PIXELS)
        except Unprocessable as error:
            assert error.code == "undecodable_photo"  # noqa: PT017
