"""Places, altitudes, headings and times of generated files, as exiftool reads them.

Of each file both read the same value. A value of exiftool that makes no sense, such as a latitude
of 45 for 45 degrees and an unknown number of minutes, is none here, and the reason is given.
"""

from __future__ import annotations

import io
import json
import shutil
import struct
import subprocess
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from PIL.ExifTags import GPS

from shared.imaging.photo_header import PhotoHeader, read_photo_header
from tests.support.hostile_headers import chunk, jpeg, segment
from tests.support.photos import encoded, photo_bytes, photo_image, sidecar_position

BYTE, ASCII, SHORT, RATIONAL, SRATIONAL, FLOAT, DOUBLE = 1, 2, 3, 5, 10, 11, 12
LETTERS = {BYTE: "B", SHORT: "H", RATIONAL: "II", SRATIONAL: "ii", FLOAT: "f", DOUBLE: "d"}
Field = tuple[int, Any]
"""Type, and text or numbers; of rationals numerators and denominators"""
Fields = dict[int, Field]


def tiff(gps: Fields, order: str = "<") -> bytes:
    """EXIF with a GPS directory alone."""
    packed = {
        tag: value.encode() + b"\0"
        if kind == ASCII
        else struct.pack(f"{order}{LETTERS[kind] * (len(value) // len(LETTERS[kind]))}", *value)
        for tag, (kind, value) in sorted(gps.items())
    }
    begin = 26 + 2 + 12 * len(gps) + 4
    entries = behind = b""
    for tag, data in packed.items():
        kind, value = gps[tag]
        count = len(data) if kind == ASCII else len(value) // len(LETTERS[kind])
        entries += struct.pack(f"{order}HHI", tag, kind, count)
        if len(data) <= 4:
            entries += data.ljust(4, b"\0")
        else:
            entries += struct.pack(f"{order}I", begin + len(behind))
            behind += data
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, 8)
    main = struct.pack(f"{order}HHHIII", 1, 0x8825, 4, 1, 26, 0)
    return head + main + struct.pack(f"{order}H", len(gps)) + entries + bytes(4) + behind


def located(
    latitude: Field, longitude: Field, letters: tuple[str, str] = ("N", "E"), **others: Field
) -> Fields:
    return {
        GPS.GPSLatitudeRef: (ASCII, letters[0]),
        GPS.GPSLatitude: latitude,
        GPS.GPSLongitudeRef: (ASCII, letters[1]),
        GPS.GPSLongitude: longitude,
        **{GPS[name]: value for name, value in others.items()},
    }


SHAPES: dict[str, tuple[Field, Field]] = {
    "seconds": ((RATIONAL, (45, 1, 4, 1, 1230, 100)), (RATIONAL, (7, 1, 40, 1, 4800, 100))),
    "minutes": ((RATIONAL, (45, 1, 4205, 1000, 0, 1)), (RATIONAL, (7, 1, 408, 10, 0, 1))),
    "two rationals": ((RATIONAL, (45, 1, 42, 10)), (RATIONAL, (7, 1, 408, 10))),
    "one rational": ((RATIONAL, (4507, 100)), (RATIONAL, (768, 100))),
    "degrees in three": ((RATIONAL, (4507, 100, 0, 1, 0, 1)), (RATIONAL, (768, 100, 0, 1, 0, 1))),
    "doubles": ((DOUBLE, (45.0, 4.0, 12.0)), (DOUBLE, (7.0, 40.0, 48.0))),
    "one double": ((DOUBLE, (45.07,)), (DOUBLE, (7.68,))),
    "floats": ((FLOAT, (45.0, 4.5, 0.0)), (FLOAT, (7.0, 40.5, 0.0))),
    "integers": ((SHORT, (45, 4, 12)), (SHORT, (7, 40, 48))),
    "text": ((ASCII, "45 4 12.3"), (ASCII, "7.68")),
}
NEGATIVE: tuple[Field, Field] = (
    (SRATIONAL, (-3802, 100, 0, 1, 0, 1)),
    (SRATIONAL, (-768, 100, 0, 1, 0, 1)),
)
SENSELESS: dict[str, Fields] = {
    "negative beside N": located(NEGATIVE[0], SHAPES["seconds"][1]),
    "no letters": located(*SHAPES["seconds"], ("", "")),
    "letters exchanged": located(*SHAPES["seconds"], ("E", "N")),
    "minutes unknown": located((RATIONAL, (45, 1, 0, 0, 0, 0)), SHAPES["seconds"][1]),
    "seconds unknown": located((RATIONAL, (45, 1, 4, 1, 0, 0)), SHAPES["seconds"][1]),
    "degrees infinite": located((RATIONAL, (45, 0, 4, 1, 1, 1)), SHAPES["seconds"][1]),
    "four numbers": located((RATIONAL, (45, 1, 4, 1, 12, 1, 1, 1)), SHAPES["seconds"][1]),
    "seconds infinite": located((RATIONAL, (45, 1, 4, 1, 9, 0)), SHAPES["seconds"][1]),
    "minutes beyond 60": located((RATIONAL, (45, 1, 75, 1, 0, 1)), SHAPES["seconds"][1]),
    "signs that differ": located(
        (SRATIONAL, (-45, 1, 4, 1, 0, 1)), SHAPES["seconds"][1], ("S", "E")
    ),
    "another datum": located(*SHAPES["seconds"], ("N", "E"), GPSMapDatum=(ASCII, "Tokyo ")),
    "latitude beyond the pole": located((RATIONAL, (95, 1)), SHAPES["seconds"][1]),
    "longitude beyond 180": located(SHAPES["seconds"][0], (RATIONAL, (200, 1))),
    "latitude only": {
        tag: value for tag, value in located(*SHAPES["seconds"]).items() if tag <= GPS.GPSLatitude
    },
}
NOWHERE: dict[str, Fields] = {
    "zeros": located((RATIONAL, (0, 1) * 3), (RATIONAL, (0, 1) * 3)),
    "zeros without letters": located((RATIONAL, (0, 1) * 3), (RATIONAL, (0, 1) * 3), ("", "")),
    "one zero": located((RATIONAL, (0, 1)), (RATIONAL, (0, 1))),
    "0/0": located((RATIONAL, (0, 0) * 3), (RATIONAL, (0, 0) * 3)),
    "nothing but a version": {GPS.GPSVersionID: (BYTE, (2, 3, 0, 0))},
}
OTHERS: dict[str, dict[str, Field]] = {
    "above the sea": {"GPSAltitude": (RATIONAL, (4012, 10)), "GPSAltitudeRef": (BYTE, (0,))},
    "below the sea": {"GPSAltitude": (RATIONAL, (4012, 10)), "GPSAltitudeRef": (BYTE, (1,))},
    "signed": {"GPSAltitude": (SRATIONAL, (-4012, 10)), "GPSAltitudeRef": (BYTE, (1,))},
    "signed, above": {"GPSAltitude": (SRATIONAL, (-4012, 10)), "GPSAltitudeRef": (BYTE, (0,))},
    "text 0": {"GPSAltitude": (RATIONAL, (4012, 10)), "GPSAltitudeRef": (ASCII, "0")},
    "text 1": {"GPSAltitude": (RATIONAL, (4012, 10)), "GPSAltitudeRef": (ASCII, "1")},
    "altitude 0/0": {"GPSAltitude": (RATIONAL, (0, 0)), "GPSAltitudeRef": (BYTE, (0,))},
    "heading": {"GPSImgDirection": (RATIONAL, (225, 10)), "GPSImgDirectionRef": (ASCII, "T")},
    "heading alone": {"GPSImgDirection": (RATIONAL, (35_999, 100))},
    "time": {"GPSDateStamp": (ASCII, "2024:05:01"), "GPSTimeStamp": (RATIONAL, (8, 1, 5, 1, 3, 1))},
}


def texts(name: str, kind: bytes, profile: bytes) -> bytes:
    """ImageMagick's profile in a chunk of text."""
    digits = f"\n{name}\n{len(profile):8}\n{profile.hex()}\n".encode()
    keyword = f"Raw profile type {name}\0".encode()
    return chunk(kind, keyword + (b"\0" + zlib.compress(digits) if kind == b"zTXt" else digits))


def webp(exif: bytes) -> bytes:
    return encoded(photo_image(1), "WEBP", exif=b"Exif\0\0" + exif)


def png(before: bytes = b"", behind: bytes = b"") -> bytes:
    whole = photo_bytes(1, "PNG")
    return whole[:33] + before + whole[33:-12] + behind + whole[-12:]


def exif_segment(exif: bytes) -> bytes:
    return segment(0xE1, b"Exif\0\0" + exif)


def containers(exif: bytes) -> dict[str, bytes]:
    """Files of all kinds with the EXIF."""
    camera = b"II*\0\x08\0\0\0\x01\0\x0f\x01\x02\0\x04\0\0\0abc\0\0\0\0\0"
    return {
        "second segment.jpg": jpeg(exif_segment(camera), exif_segment(exif)),
        "first segment.jpg": jpeg(exif_segment(exif), exif_segment(camera)),
        "split.jpg": jpeg(exif_segment(exif[:60]), exif_segment(exif[60:])),
        "eXIf.png": png(chunk(b"eXIf", exif)),
        "eXIf behind.png": png(behind=chunk(b"eXIf", exif)),
        "exif profile.png": png(texts("exif", b"zTXt", b"Exif\0\0" + exif)),
        "APP1 profile behind.png": png(behind=texts("APP1", b"tEXt", b"Exif\0\0" + exif)),
        "vp8x.webp": webp(exif),
    }


def packet(latitude: str, longitude: str, more: str = "") -> bytes:
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:exif="http://ns.adobe.com/exif/1.0/"'
        f' exif:GPSLatitude="{latitude}"{more}><exif:GPSLongitude>{longitude}</exif:GPSLongitude>'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()


PACKETS = {
    "minutes": packet("45,4.2N", "7,40.8E"),
    "south and west": packet("45,4.2S", "7,40.8W"),
    "seconds": packet("45,4,12N", "7,40,48W"),
    "decimal with letters": packet("45.07S", "7.68E"),
    "signed": packet("-45.07", "7.68"),
    "altitude": packet("45.07N", "7.68E", ' exif:GPSAltitude="4012/10" exif:GPSAltitudeRef="1"'),
    "heading": packet("45.07N", "7.68E", ' exif:GPSImgDirection="225/10"'),
}
XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
XMP_FILES = {
    "segment.jpg": lambda xmp: jpeg(segment(0xE1, XMP_PREFIX + xmp)),
    "iTXt.png": lambda xmp: png(chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + xmp)),
    "profile behind.png": lambda xmp: png(behind=texts("xmp", b"zTXt", xmp)),
    "packet.webp": lambda xmp: encoded(photo_image(1), "WEBP", xmp=xmp),
}
# What exiftool itself writes, into a JPEG, PNG, WebP and TIFF each.
WRITTEN = {
    "all": [
        *("-GPSLatitude=45.07", "-GPSLatitudeRef=S", "-GPSLongitude=7.68", "-GPSLongitudeRef=W"),
        *("-GPSAltitude=12.5", "-GPSAltitudeRef=1", "-GPSImgDirection=22.5"),
    ],
    "time": [
        *("-DateTimeOriginal=2024:05:01 10:00:00", "-OffsetTimeOriginal=+02:00"),
        "-SubSecTimeOriginal=25",
    ],
    "xmp": [
        *("-XMP:GPSLatitude=-45.07", "-XMP:GPSLongitude=7.68"),
        *("-XMP:GPSAltitude=12.5", "-XMP:GPSAltitudeRef=1"),
    ],
}


@dataclass(frozen=True)
class Variant:
    name: str
    data: bytes
    kind: str = "sense"
    """`sense`, or `senseless` or `nowhere` for coordinates that are none"""

    @property
    def filename(self) -> str:
        return self.name.replace("/", " of ")


def variants() -> Iterator[Variant]:
    for (shape, values), order, letters in product(
        SHAPES.items(), "<>", (("N", "E"), ("s", "West"))
    ):
        data = jpeg(exif_segment(tiff(located(*values, letters), order)))
        yield Variant(f"{shape} {ord(order)} {letters[0]}.jpg", data)
    for letters, shape in product((("N", "W"), ("S", "E")), ("seconds", "one rational")):
        exif = tiff(located(*SHAPES[shape], letters))
        for name, data in containers(exif).items():
            yield Variant(f"{letters[0]} {shape} {name}", data)
    yield Variant("negative.jpg", jpeg(exif_segment(tiff(located(*NEGATIVE, ("S", "W"))))))
    for name, others in OTHERS.items():
        fields = located(*SHAPES["seconds"], ("N", "E"), **others)
        yield Variant(f"{name}.jpg", jpeg(exif_segment(tiff(fields))))
    for (name, xmp), (file, build) in product(PACKETS.items(), XMP_FILES.items()):
        yield Variant(f"{name} {file}", build(xmp))
    for kind, each in (("senseless", SENSELESS), ("nowhere", NOWHERE)):
        for name, fields in each.items():
            data = jpeg(exif_segment(tiff(fields)))
            yield Variant(f"{kind} {name}.jpg", data, kind)


def run_exiftool(*arguments: str, lines: list[str]) -> str:
    program = shutil.which("exiftool")
    if program is None:
        pytest.fail("exiftool is missing: apt install libimage-exiftool-perl")
    done = subprocess.run(
        [program, *arguments, "-@", "-"],
        input="\n".join(lines),
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout


def degrees(tags: dict[str, Any], name: str) -> float | None:
    found = tags.get(f"Composite:{name}", tags.get(f"XMP-exif:{name}"))
    return None if found in (None, "") else float(found)


def exiftools_time(tags: dict[str, Any]) -> datetime | None:
    text = tags.get("Composite:GPSDateTime") or tags.get("Composite:SubSecDateTimeOriginal")
    return text and datetime.fromisoformat(text.replace(":", "-", 2).replace("Z", "+00:00"))


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Variant, dict[str, Any]]]:
    """The variants, and the tags that exiftool reads of each."""
    folder = tmp_path_factory.mktemp("variants")
    made = {variant.filename: variant for variant in variants()}
    for name, variant in made.items():
        (folder / name).write_bytes(variant.data)
    lines = []
    for (name, options), media in product(WRITTEN.items(), ("JPEG", "PNG", "WEBP", "TIFF")):
        path = folder / f"{name} by exiftool.{media.lower()}"
        path.write_bytes(photo_bytes(1, media))
        lines += [*options, "-n", "-overwrite_original", str(path), "-execute"]
    run_exiftool(lines=lines)
    read = run_exiftool(
        *("-json", "-n", "-G1", "-Composite:all", "-GPS:all", "-XMP:all"), lines=[str(folder)]
    )
    return [
        (made.get(path.name) or Variant(path.name, path.read_bytes()), tags)
        for tags in json.loads(read)
        for path in [Path(tags["SourceFile"])]
    ]


def header_of(variant: Variant) -> PhotoHeader:
    return read_photo_header(io.BytesIO(variant.data), 10**9)


def test_more_than_a_hundred_variants_are_compared(
    compared: list[tuple[Variant, dict[str, Any]]],
) -> None:
    assert len(compared) == len({variant.name for variant, _ in compared}) > 130
    assert sum(degrees(tags, "GPSLatitude") is not None for _, tags in compared) > 110


def test_values_are_those_of_exiftool(compared: list[tuple[Variant, dict[str, Any]]]) -> None:
    for variant, tags in compared:
        if variant.kind != "sense":
            continue
        found = header_of(variant)
        altitude = tags.get("Composite:GPSAltitude", tags.get("GPS:GPSAltitude"))
        expected = [
            degrees(tags, "GPSLatitude"),
            degrees(tags, "GPSLongitude"),
            altitude if isinstance(altitude, int | float) else None,
            tags.get("GPS:GPSImgDirection", tags.get("XMP-exif:GPSImgDirection")),
        ]
        values = [found.latitude, found.longitude, found.altitude, found.heading]
        assert values == pytest.approx(expected, abs=1e-6), variant.name
        assert found.captured_at == exiftools_time(tags), variant.name
        assert found.gps_error is None, variant.name


def test_invalid_gps_coordinates_are_ignored_with_a_reason(
    compared: list[tuple[Variant, dict[str, Any]]],
) -> None:
    for variant, _ in compared:
        if variant.kind == "sense":
            continue
        found = header_of(variant)
        assert (found.latitude, found.longitude) == (None, None), variant.name
        assert (found.gps_error is not None) == (variant.kind == "senseless"), variant.name


@pytest.mark.parametrize(("letter", "sign"), [("N", 1), ("S", -1)])
def test_letters_beside_decimal_degrees_in_xmp_count_as_apple_writes_them(
    letter: str, sign: int
) -> None:
    """exiftool reads the number alone, and so takes south for north."""
    xmp = packet("45.2", "7.9", f' exif:GPSLatitudeRef="{letter}" exif:GPSLongitudeRef="E"')
    assert sidecar_position(xmp) == (sign * 45.2, 7.9)
