"""What is said beside the pixels: EXIF, names, fields of the form."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterator

from tests.support.hostile.file import BAD_FIELD, FINE, Hostile, photo


def _with_exif(number: int, block: bytes) -> bytes:
    whole = photo(number)
    body = b"Exif\0\0" + block
    return whole[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + whole[2:]


def _ifd(*entries: tuple[int, int, int, bytes], then: int = 0, at: int = 8) -> bytes:
    """A big-endian EXIF block of one directory."""
    directory = struct.pack(">H", len(entries))
    for tag, kind, count, value in entries:
        directory += struct.pack(">HHI", tag, kind, count) + value.ljust(4, b"\0")[:4]
    return b"MM\0*" + struct.pack(">I", at) + directory + struct.pack(">I", then)


def exif() -> Iterator[Hostile]:
    offset = struct.pack(">I", 8)
    beyond = struct.pack(">I", 2**32 - 1)
    blocks = {
        "nothing": b"",
        "no directory": b"MM\0*",
        "a directory beyond the end": _ifd(at=2**32 - 1),
        "a directory before the begin": _ifd(at=0),
        "a directory that follows itself": _ifd((0x0112, 3, 1, b"\0\x01"), then=8),
        "a GPS directory that is the first one": _ifd((0x8825, 4, 1, offset)),
        "an inner directory that is the first one": _ifd((0x8769, 4, 1, offset)),
        "a GPS directory beyond the end": _ifd((0x8825, 4, 1, beyond)),
        "a GPS directory that is text": _ifd((0x8825, 2, 4, b"abc\0")),
        "an orientation of 4 billion values": _ifd((0x0112, 3, 2**32 - 1, offset)),
        "an orientation of 99": _ifd((0x0112, 3, 1, b"\0\x63")),
        "an orientation that is text": _ifd((0x0112, 2, 4, b"abc\0")),
        "a tag of an unknown type": _ifd((0x0112, 99, 1, b"\0\x01")),
        "sixty thousand entries": b"MM\0*" + struct.pack(">IH", 8, 60_000) + bytes(60_000),
        "a time that is none": _ifd((0x9003, 2, 20, offset), (0x8769, 4, 1, offset)),
    }
    for number, (what, block) in enumerate(blocks.items()):
        yield Hostile(f"EXIF: {what}", _with_exif(40 + number, block), FINE)
    dice = random.Random(1)
    for seed in range(10):
        block = b"MM\0*\0\0\0\x08" + dice.randbytes(300)
        yield Hostile(f"EXIF: noise {seed}", _with_exif(60 + seed, block), FINE)
    for number, (top, bottom) in enumerate(((0, 0), (2**32 - 1, 1), (1, 0), (999, 1))):
        # Degrees as fractions: not a number, beyond every map, infinite, beyond the pole.
        thirds = struct.pack(">II", top, bottom) * 3
        gps_at = 8 + 2 + 12 + 4
        gps = struct.pack(">H", 4)
        for tag, kind, count, value in (
            (1, 2, 2, b"N\0\0\0"),
            (2, 5, 3, struct.pack(">I", gps_at + 2 + 4 * 12 + 4)),
            (3, 2, 2, b"E\0\0\0"),
            (4, 5, 3, struct.pack(">I", gps_at + 2 + 4 * 12 + 4)),
        ):
            gps += struct.pack(">HHI", tag, kind, count) + value
        block = _ifd((0x8825, 4, 1, struct.pack(">I", gps_at))) + gps + bytes(4) + thirds
        yield Hostile(f"EXIF: {top}/{bottom} degrees", _with_exif(75 + number, block), FINE)


def names() -> Iterator[Hostile]:
    names = (
        "../../../../etc/passwd",
        "..\\..\\windows\\system32\\photo.jpg",
        "/etc/cron.d/photo.jpg",
        "C:\\photo.jpg",
        "....//....//photo.jpg",
        "%2e%2e%2fphoto.jpg",
        "photo.jpg\r\nX-Evil: 1",
        "photo\u202egpj.exe",
        "<img src=x onerror=alert(1)>.jpg",
        "'; DROP TABLE photos; --.jpg",
        "CON.jpg",
        "-rf.jpg",
        "$(id).jpg",
        "{{7*7}}.jpg",
    )
    for number, name in enumerate(names):
        yield Hostile(f"name {name[:30]!r}", photo(130 + number), FINE, filename=name)
    too_long = frozenset({"malformed_body"})  # more than a part of a form may say of itself
    yield Hostile("a name of 5000 letters", photo(149), too_long, filename="x" * 5000 + ".jpg")


def fields() -> Iterator[Hostile]:
    bad = (
        {"latitude": "nan", "longitude": "nan"},
        {"latitude": "inf", "longitude": "0"},
        {"latitude": "-inf", "longitude": "0"},
        {"latitude": "1e999", "longitude": "0"},
        {"latitude": "91", "longitude": "0"},
        {"latitude": "0", "longitude": "181"},
        {"latitude": "0"},
        {"longitude": "0"},
        {"latitude": "0x10", "longitude": "0"},
        {"latitude": "45,07", "longitude": "7,69"},
        {"latitude": "\0", "longitude": "0"},
        {"heading": "nan"},
        {"heading": "-1"},
        {"captured_at": "yesterday"},
        {"captured_at": "9999999-01-01"},
        {"place": "a\0b"},
        {"tags": "a\0b"},
        {"metadata": "[]"},
        {"metadata": "{"},
        {"metadata": '{"a": "\\u0000"}'},
        {"metadata": '{"a":' * 100 + "1" + "}" * 100},
        {"role": "admin"},
    )
    for number, fields in enumerate(bad):
        said = json.dumps(fields)[:50]
        yield Hostile(f"fields {said}", photo(150 + number), BAD_FIELD, fields=fields)
