"""What the gateway reads from a photo's header, without decoding a pixel."""

from __future__ import annotations

import io
import random
import struct
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from math import hypot
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.PngImagePlugin import PngInfo

from shared.errors import Unprocessable
from shared.imaging.decode import decode_photo
from shared.imaging.file_structure import open_photo, read_structure
from shared.imaging.photo_header import PhotoHeader, read_photo_header
from shared.imaging.preprocessing import get_preprocessing
from tests.support.hostile_headers import (
    MANY_PARTS,
    chunk,
    gps_of_many_values,
    heic,
    jpeg,
    png,
    segment,
    webp,
)
from tests.support.photos import photo_bytes, photo_image

PIXELS = 50_000_000
Tags = dict[Any, Any]


def encoded(media: str = "JPEG", **options: Any) -> bytes:
    return photo_bytes(1, media, **options)


def header(data: bytes, max_pixels: int = PIXELS) -> PhotoHeader:
    """The header, read while Pillow can open nothing."""

    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("the gateway gave a photo to Pillow")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Image, "open", refuse)
        patch.setattr(Image.Exif, "load", refuse)
        return read_photo_header(io.BytesIO(data), max_pixels)


def exif_with(
    gps: Tags | None = None,
    camera: Tags | None = None,
    main: Tags | None = None,
) -> Image.Exif:
    exif = Image.Exif()
    exif.update(main or {})
    for directory, tags in ((IFD.GPSInfo, gps), (IFD.Exif, camera)):
        if tags:  # twice, because Pillow's writers look in different places
            exif.get_ifd(directory).update(tags)
            exif[directory] = tags
    return exif


def position(north: str, east: str) -> Tags:
    return {
        GPS.GPSLatitudeRef: north,
        GPS.GPSLatitude: (45.0, 4.0, 12.0),
        GPS.GPSLongitudeRef: east,
        GPS.GPSLongitude: (7.0, 30.0, 36.0),
    }


def taken(gps: Tags | None, camera: Tags | None) -> datetime | None:
    return header(encoded(exif=exif_with(gps, camera))).captured_at


def reason(data: bytes, max_pixels: int = PIXELS) -> Unprocessable:
    with pytest.raises(Unprocessable) as caught:
        header(data, max_pixels)
    return caught.value


@pytest.mark.parametrize(("fields", "heading"), [(12.5, 12.5), (0, 0), (360, 0), (372.5, 12.5)])
def test_heading_is_normalised_to_below_360_degrees(fields: float, heading: float) -> None:
    found = header(encoded(exif=exif_with({GPS.GPSImgDirection: fields})))
    assert found.heading == pytest.approx(heading)


def test_a_magnetic_heading_is_converted_where_place_and_time_are_known() -> None:
    """West of Auckland, the declination of 2024 is some 20 degrees east."""
    auckland = {
        **position("S", "E"),
        GPS.GPSLatitude: (36.0, 48.0, 14.4),
        GPS.GPSLongitude: (174.0, 43.0, 35.4),
        GPS.GPSImgDirection: 22.0,
        GPS.GPSImgDirectionRef: "M",
    }
    found = header(encoded(exif=exif_with(auckland, CAMERA_TIME)))
    assert found.heading == pytest.approx(42, abs=1)
    for gps, camera in (
        (auckland, None),
        ({GPS.GPSImgDirection: 22.0, GPS.GPSImgDirectionRef: "M"}, CAMERA_TIME),
        (auckland, {Base.DateTimeOriginal: "1999:05:06 12:20:31"}),
    ):
        unknown = header(encoded(exif=exif_with(gps, camera)))
        assert (unknown.heading, unknown.has_heading) == (None, True)


def test_the_hash_of_a_picture_is_that_of_its_pixels_and_orientation() -> None:
    def hash_of(data: bytes, path: str = "a.jpg") -> str:
        picture = header(data).picture
        assert picture is not None
        return picture.sha256(io.BytesIO(data), path)

    for media in ("JPEG", "PNG", "WEBP", "TIFF"):
        plain = encoded(media)
        tagged = encoded(media, exif=exif_with(position("N", "E"), CAMERA_TIME))
        turned = encoded(media, exif=exif_with(main={Base.Orientation: 6}))
        assert hash_of(plain) == hash_of(tagged) != hash_of(turned), media
        assert hash_of(plain) != hash_of(plain, "b.jpg")
        assert hash_of(plain) != hash_of(photo_bytes(2, media))
    assert header(encoded("BMP")).picture is None


GPS_TIME: Tags = {GPS.GPSDateStamp: "2024:05:06", GPS.GPSTimeStamp: (10.0, 20.0, 30.5)}
CAMERA_TIME: Tags = {
    Base.DateTimeOriginal: "2024:05:06 12:20:31",
    Base.OffsetTimeOriginal: "+02:00",
}


@pytest.mark.parametrize(
    "gps",
    [
        {GPS.GPSDateStamp: "2024:05:06"},
        {**GPS_TIME, GPS.GPSDateStamp: "yesterday"},
        {**GPS_TIME, GPS.GPSTimeStamp: (10.0, 20.0)},
        {GPS.GPSDateStamp: "9999:12:31", GPS.GPSTimeStamp: (4e9, 0.0, 0.0)},
    ],
)
def test_camera_time_is_used_where_the_gps_time_is_invalid(gps: Tags) -> None:
    assert taken(gps, CAMERA_TIME) == datetime(2024, 5, 6, 10, 20, 31, tzinfo=UTC)


@pytest.mark.parametrize(
    ("orientation", "media"),
    [
        *((number, "JPEG") for number in range(1, 9)),
        *((number, media) for number in (1, 6) for media in ("PNG", "WEBP", "TIFF")),
        (1, "BMP"),
    ],
)
def test_size_is_that_of_the_upright_photo(orientation: int, media: str) -> None:
    found = header(encoded(media, exif=exif_with(main={Base.Orientation: orientation})))
    upright = (48, 64) if orientation >= 5 else (64, 48)
    assert (found.width, found.height) == upright


@pytest.mark.parametrize(
    ("exif", "error"),
    [
        (b"Exif\0\0nonsense", "the EXIF has no TIFF header"),
        (b"Exif\0\0", None),
        (b"Exif\0\0II*\0\xff\xff\xff\xff", "its EXIF is damaged"),
        (b"Exif\0\0II*\0\x08\0\0\0\xff\xff" + bytes(40), None),
    ],
)
def test_broken_exif_yields_no_values_and_a_reason(exif: bytes, error: str | None) -> None:
    assert header(encoded(exif=exif)) == PhotoHeader(width=64, height=48, gps_error=error)


@pytest.mark.parametrize(
    ("tags", "metres"),
    [
        ({GPS.GPSAltitude: 238.5, GPS.GPSAltitudeRef: b"\0"}, 238.5),
        ({GPS.GPSAltitude: 238.5}, 238.5),
        ({GPS.GPSAltitude: 12.25, GPS.GPSAltitudeRef: b"\1"}, -12.25),
        ({GPS.GPSAltitude: 12.25, GPS.GPSAltitudeRef: b"\3"}, -12.25),
        ({GPS.GPSAltitude: 4e8}, None),
        ({GPS.GPSAltitudeRef: b"\0"}, None),
    ],
)
def test_altitude_is_negative_below_the_sea(tags: Tags, metres: float | None) -> None:
    found = header(encoded(exif=exif_with(tags)))
    assert found.altitude == (None if metres is None else pytest.approx(metres))


SENSOR = {Base.FocalLength: 4.0, Base.FocalPlaneXResolution: 5000.0}


@pytest.mark.parametrize(
    ("tags", "multiple"),
    [
        ({Base.FocalLengthIn35mmFilm: 27}, 27 / hypot(36, 24) * hypot(64, 48) / 64),
        ({Base.FocalLengthIn35mmFilm: 27, **SENSOR}, 27 / hypot(36, 24) * hypot(64, 48) / 64),
        ({Base.FocalLengthIn35mmFilm: 0}, None),
        ({Base.FocalLength: 4.0}, None),
        ({**SENSOR, Base.ExifImageWidth: 600, Base.ExifImageHeight: 800}, 4 / 25.4 * 5000 / 800),
        ({**SENSOR, Base.FocalPlaneXResolution: 300.0, Base.FocalPlaneResolutionUnit: 3}, 1.875),
        ({**SENSOR, Base.FocalPlaneResolutionUnit: 9}, None),
        ({Base.FocalLengthIn35mmFilm: 65_000}, None),
    ],
)
def test_focal_length_is_a_multiple_of_the_longer_side(tags: Tags, multiple: float | None) -> None:
    found = header(encoded(exif=exif_with(camera=tags)))
    assert found.focal_length == (None if multiple is None else pytest.approx(multiple))


def whole_exif() -> bytes:
    everything: Tags = {**position("N", "E"), **GPS_TIME, GPS.GPSImgDirection: 12.5}
    data: bytes = exif_with(
        everything, CAMERA_TIME, {Base.Orientation: 6, Base.Make: "m"}
    ).tobytes()
    return data


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), media=st.sampled_from(["JPEG", "PNG", "WEBP"]))
def test_photos_with_damaged_exif_are_accepted(seed: int, media: str) -> None:
    rng = random.Random(seed)
    exif = bytearray(whole_exif())
    for _ in range(rng.choice([1, 2, 10, 40])):
        exif[rng.randrange(6, len(exif))] = rng.choice(
            [0, 1, 2, 5, 10, 12, 255, rng.randrange(256)]
        )
    exif = exif[: rng.choice([len(exif), rng.randrange(6, len(exif))])]
    found = header(encoded(media, exif=bytes(exif)))
    assert sorted((found.width, found.height)) == [48, 64]
    assert found.heading is None or 0 <= found.heading < 360
    assert (found.latitude is None) == (found.longitude is None)
    assert found.captured_at is None or found.captured_at.utcoffset() == UTC.utcoffset(None)


def png_without_pixels(width: int, height: int, *between: bytes) -> bytes:
    """A PNG whose pixels are missing: only a reader of headers can make sense of it."""
    size = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + b"".join(between)


def test_png_whose_end_is_not_reached_may_have_coordinates() -> None:
    cut_off = png_without_pixels(30, 20, chunk(b"IDAT", b"no pixels"))
    assert header(cut_off).gps_error == "its header is cut off"
    many = png_without_pixels(30, 20, *[chunk(b"IDAT", b"")] * 30_000)
    with bounded_work():
        assert header(many).gps_error == "its header has more than 20000 parts"


def test_too_many_pixels_are_refused_from_the_header_alone() -> None:
    bomb = png_without_pixels(60_000, 60_000, chunk(b"IDAT", b""))
    error = reason(bomb)
    assert error.code == "too_many_pixels"
    assert "60000 x 60000" in error.detail
    assert f"{PIXELS / 1e6:g} megapixels" in error.detail
    assert "MAX_IMAGE_PIXELS in the environment" in error.detail


def test_what_is_no_photo_or_ends_within_its_header_is_undecodable() -> None:
    truncated = [encoded(media)[:20] for media in ("JPEG", "PNG", "WEBP", "BMP", "TIFF")]
    for data in (b"", b"\xff\xd8\xff", b"not a photo", b"GIF89a" + bytes(30), *truncated):
        assert reason(data).code == "undecodable_photo"


MAX_CALLS = 500_000  # of functions; 20,000 parts take some 150,000


@contextmanager
def bounded_work() -> Iterator[None]:
    """Fail as soon as more than MAX_CALLS functions were called, instead of waiting for hours."""
    calls = 0

    def count(_: Any, event: str, __: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")
        if calls > MAX_CALLS:
            sys.setprofile(None)
            raise AssertionError(f"more than {MAX_CALLS} calls")

    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(None)


@pytest.mark.parametrize(
    ("kind", "size_bytes"),
    [("HEIC: extents without bytes", 780), *((kind, 6_200_000) for kind in MANY_PARTS)],
)
def test_header_of_too_many_parts_is_refused_after_bounded_work(kind: str, size_bytes: int) -> None:
    data = MANY_PARTS[kind](size_bytes)
    with bounded_work():
        assert reason(data).code == "undecodable_photo"
    with bounded_work(), pytest.raises((ValueError, OSError)):
        open_photo(io.BytesIO(data))


@pytest.mark.parametrize("media", ["JPEG", "PNG", "WEBP", "HEIC"])
def test_exif_of_many_values_costs_bounded_work(media: str) -> None:
    block = gps_of_many_values(5000, 500)
    larger = gps_of_many_values(60_000, 20_000)
    data = {
        "JPEG": jpeg(segment(0xE1, b"Exif\0\0" + gps_of_many_values(4000, 500))),
        "PNG": png(chunk(b"eXIf", larger)),
        "WEBP": webp((b"EXIF", block)),
        "HEIC": heic(struct.pack(">HHHII", 2, 0, 1, 10_000, 4 + len(larger))).ljust(10_000, b"\0")
        + bytes(4)
        + larger,
    }[media]
    with bounded_work():
        found = header(data)
    assert found.latitude is None


def test_tiff_of_many_values_costs_bounded_work() -> None:
    tiff = photo_bytes(1, "TIFF")
    (at,) = struct.unpack_from("<I", tiff, 4)
    (count,) = struct.unpack_from("<H", tiff, at)
    own = tiff[at + 2 : at + 2 + 12 * count]
    # Orientation, too, has more values than anything that is read.
    more = b"".join(
        struct.pack("<HHII", tag, 5, 100_000, 8) for tag in (0x0112, *range(20_000, 60_000))
    )
    directory = struct.pack("<H", count + 40_001) + own + more + bytes(4)
    data = tiff[:4] + struct.pack("<I", 1_000_000) + tiff[8:].ljust(999_992, b"\0") + directory
    with bounded_work():
        found = header(data)
    assert (found.width, found.height, found.latitude) == (64, 48, None)


def test_jpeg_with_the_segments_of_a_panorama_with_depth_and_sound_is_read() -> None:
    """XMP of 10 MB in 150 segments, a colour profile, an index of pictures, EXIF in two parts."""
    exif = whole_exif().removeprefix(b"Exif\0\0")
    more = [
        segment(0xE1, b"Exif\0\0" + exif[:100]),
        segment(0xE1, b"Exif\0\0" + exif[100:]),
        segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta/>"),
        *[segment(0xE1, b"http://ns.adobe.com/xmp/extension/\0" + bytes(65_000))] * 150,
        *[segment(0xE2, b"ICC_PROFILE\0\x01\x09" + bytes(60_000))] * 9,
        segment(0xE2, b"MPF\0II*\0\x08\0\0\0\0\0"),
        b"\xff" * 500 + bytes(500),
    ]
    data = jpeg(*more)
    found = header(data)
    assert (found.width, found.height) == (48, 64)
    assert found.latitude == pytest.approx(45.07)
    assert read_structure(io.BytesIO(data)).metadata.xmp == [b"<x:xmpmeta/>"]
    decode_photo(data, get_preprocessing("square32"), PIXELS)


def test_jpeg_that_ends_between_its_size_and_its_pixels_has_a_header_unless_a_segment_is_cut() -> (
    None
):
    whole = encoded()
    pixels = whole.index(b"\xff\xda")
    assert header(whole[:pixels]) == PhotoHeader(width=64, height=48)
    assert reason(whole[: pixels - 1]).detail == (
        "The photo can't be decoded: its header is cut off."
    )


XMP = b"<x:xmpmeta>somewhere</x:xmpmeta>"
TEXTS = PngInfo()
TEXTS.add_itxt("XML:com.adobe.xmp", XMP.decode())


@pytest.mark.parametrize(
    ("media", "options"),
    [
        ("JPEG", {"xmp": XMP, "progressive": True}),
        ("PNG", {"pnginfo": TEXTS}),
        ("WEBP", {"xmp": XMP}),
        ("WEBP", {"xmp": XMP, "lossless": True}),
        ("WEBP", {"xmp": XMP, "save_all": True, "append_images": [photo_image(2)]}),
        ("TIFF", {}),
        ("TIFF", {"big_tiff": True}),
    ],
)
def test_xmp_exif_and_size_are_those_that_pillow_reads(media: str, options: Any) -> None:
    main: Tags = {Base.Make: "m", Base.Model: "n"}
    if media == "TIFF":
        main[700] = XMP  # Pillow's other way of writing it is ignored beside EXIF
    data = encoded(media, exif=exif_with(position("S", "W"), CAMERA_TIME, main), **options)
    found = header(data)
    with Image.open(io.BytesIO(data)) as image:
        assert (found.width, found.height) == image.size
        assert read_structure(io.BytesIO(data)).metadata.xmp == [image.info["xmp"]] == [XMP]
    assert found.latitude == pytest.approx(-45.07)
    assert found.longitude == pytest.approx(-7.51)
    assert found.captured_at == datetime(2024, 5, 6, 10, 20, 31, tzinfo=UTC)
    assert found.camera == "m n"


def test_compressed_xmp_of_a_png_is_unpacked_up_to_a_limit() -> None:
    def packed(text: bytes) -> bytes:
        return png(chunk(b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(text)))

    read = [
        read_structure(io.BytesIO(packed(text))).metadata
        for text in (b"<x:xmpmeta/>", bytes(80_000_000))
    ]
    assert [(each.xmp, each.unread) for each in read] == [
        ([b"<x:xmpmeta/>"], None),
        ([], "its XMP is damaged, or larger than 1 MB"),
    ]


def test_tiff_whose_width_is_infinite_is_undecodable() -> None:
    entry = struct.pack("<HHIf", 256, 11, 1, float("inf"))
    data = b"II*\0\x08\0\0\0" + struct.pack("<H", 1) + entry + bytes(4)
    assert reason(data).code == "undecodable_photo"
