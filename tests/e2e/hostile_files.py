"""Hostile and malformed files, the same on every run, each with its allowed outcomes."""

from __future__ import annotations

import gzip
import io
import random
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from PIL import Image

from tests.support.archives import tar_of, zip_of
from tests.support.photos import photo_bytes, photo_image

FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")
MAX_BYTES = 500_000  # of a photo, where the corpus is put in
MAX_PIXELS = 1_000_000

SUCCEEDED = frozenset({"succeeded"})
NO_PHOTO = frozenset({"unsupported_photo"})
BROKEN = frozenset({"undecodable_photo", "unsupported_photo"})
TOO_LARGE = frozenset({"too_many_pixels", "undecodable_photo"})
ANY_OUTCOME = SUCCEEDED | BROKEN | TOO_LARGE


@dataclass(frozen=True, slots=True)
class HostileFile:
    """One file of the corpus."""

    name: str
    data: bytes
    allowed: frozenset[str]
    """Error codes, and `succeeded` where its photo may be indexed."""
    filename: str = "photo.jpg"


def photo(number: int, media: str = "JPEG") -> bytes:
    """None that two files of the corpus share."""
    return photo_bytes(10_000 + number, media)


def of_another_kind() -> Iterator[HostileFile]:
    kinds = {
        "gif": b"GIF89a" + bytes(100),
        "html": b"<!doctype html><script>alert(1)</script>",
        "svg that includes a file": b"<!DOCTYPE s [<!ENTITY x SYSTEM 'file:///etc/passwd'>]><s>&x;</s>",
        "program": b"\x7fELF\x02\x01\x01" + bytes(100),
        "postscript": b"%!PS-Adobe-3.0 EPSF-3.0\n(/etc/passwd) (r) file\n",
        "image magick": b"push graphic-context\nfill 'url(https://127.0.0.1/|id)'\n",
        "zip": zip_of({"a.jpg": photo(0)}),
        "gzip": gzip.compress(photo(0)),
        "mp4": b"\0\0\0\x20ftypisom" + bytes(100),
        "avif": b"\0\0\0\x20ftypavif" + bytes(100),
        "text that begins like a bitmap": b"BMost of this is text, and no picture.",
        "one byte": b"\xff",
        "zeros": bytes(1000),
    }
    for kind, data in kinds.items():
        yield HostileFile(f"{kind} called a photo", data, NO_PHOTO)
    yield HostileFile("nothing", b"", frozenset({"empty_file"}))
    too_large = photo(1) + bytes(MAX_BYTES)
    yield HostileFile("more bytes than allowed", too_large, frozenset({"file_too_large"}))


def cut_off() -> Iterator[HostileFile]:
    for media in FORMATS:
        whole = photo(2, media)
        for length in (2, 4, 12, 30, len(whole) // 4, len(whole) // 2, len(whole) * 9 // 10):
            yield HostileFile(f"{media} cut off after {length} bytes", whole[:length], BROKEN)


def polyglots() -> Iterator[HostileFile]:
    page = b"<html><script>alert(1)</script></html>"
    yield HostileFile("JPEG and page", photo(20) + page, SUCCEEDED, "photo.html")
    yield HostileFile("JPEG and zip", photo(21) + zip_of({"a": b"b"}), SUCCEEDED, "photo.zip")
    yield HostileFile(
        "JPEG and program", photo(22) + b"\x7fELF" + bytes(99), SUCCEEDED, "photo.exe"
    )
    php = b"\xff\xfe" + struct.pack(">H", 30) + b"<?php system($_GET['c']); ?>"
    whole = photo(23)
    yield HostileFile(
        "JPEG with a program in a comment", whole[:2] + php + whole[2:], SUCCEEDED, "x.php"
    )
    png = photo(24, "PNG")
    yield HostileFile("PNG and page", png + page, SUCCEEDED, "photo.svg")
    yield HostileFile("GIF and JPEG", b"GIF89a" + photo(25), NO_PHOTO)
    yield HostileFile("PDF and JPEG", b"%PDF-1.7\n" + photo(26), NO_PHOTO)
    yield HostileFile("page and JPEG", page + photo(27), NO_PHOTO)


def noise() -> Iterator[HostileFile]:
    dice = random.Random(2)
    for media in FORMATS:
        for seed in range(5):
            data = bytearray(photo(100 + seed, media))
            for _ in range(2**seed):
                data[dice.randrange(4, len(data))] = dice.randrange(256)
            yield HostileFile(f"{media} with noise {seed}", bytes(data), ANY_OUTCOME)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(width: int, height: int, *chunks: bytes) -> bytes:
    header = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    pixels = _chunk(b"IDAT", zlib.compress(bytes(100)))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + pixels + _chunk(b"IEND", b"")


def _jpeg(width: int, height: int) -> bytes:
    whole = bytearray(photo(3))
    frame = whole.index(b"\xff\xc0")
    whole[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(whole)


def _bmp(width: int, height: int) -> bytes:
    whole = bytearray(photo(4, "BMP"))
    whole[18:26] = struct.pack("<ii", width, height)
    return bytes(whole)


def _webp(width: int, height: int) -> bytes:
    sizes = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    extended = b"VP8X" + struct.pack("<I", 10) + bytes(4) + sizes
    body = b"WEBP" + extended + photo(5, "WEBP")[12:]
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _tiff(width: int, height: int) -> bytes:
    entries = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 8), (279, 64)]
    directory = struct.pack("<H", len(entries))
    for tag, value in entries:
        directory += struct.pack("<HHII", tag, 4, 1, value)
    return b"II*\0" + struct.pack("<I", 8) + directory + bytes(4 + 64)


def huge() -> Iterator[HostileFile]:
    large = {
        "PNG": (_png, [(2**31 - 1, 2**31 - 1), (100_000, 100_000), (1, 2**31 - 1)]),
        "JPEG": (_jpeg, [(65_500, 65_500), (65_500, 16), (2000, 2000)]),
        "BMP": (_bmp, [(2**31 - 1, 2**31 - 1), (100_000, 100_000), (2000, -2000)]),
        "WEBP": (_webp, [(16_383, 16_383), (2**24, 2**24), (2000, 2000)]),
        "TIFF": (_tiff, [(2**32 - 1, 2**32 - 1), (100_000, 100_000), (2000, 2000)]),
    }
    for media, (make, sizes) in large.items():
        for width, height in sizes:
            yield HostileFile(f"{media} of {width} x {height}", make(width, height), TOO_LARGE)
    yield HostileFile("PNG of 0 x 0", _png(0, 0), BROKEN)
    yield HostileFile("BMP of 0 x 0", _bmp(0, 0), BROKEN)
    yield HostileFile("TIFF of 0 x 0", _tiff(0, 0), BROKEN)
    yield HostileFile("PNG with fewer pixels than it says", _png(900, 900), BROKEN)
    yield HostileFile("TIFF with fewer pixels than it says", _tiff(900, 900), BROKEN)


def bombs() -> Iterator[HostileFile]:
    packed = zlib.compress(bytes(80_000_000), 9)
    either = BROKEN | SUCCEEDED
    yield HostileFile("PNG: text bomb", _png(8, 8, _chunk(b"zTXt", b"a\0\0" + packed)), either)
    international = _chunk(b"iTXt", b"a\0\x01\0\0\0" + packed)
    yield HostileFile("PNG: international text bomb", _png(8, 8, international), either)
    yield HostileFile("PNG: profile bomb", _png(8, 8, _chunk(b"iCCP", b"a\0\0" + packed)), either)
    pixels = _chunk(b"IDAT", packed)
    yield HostileFile("PNG: more pixels than it says", _png(8, 8, pixels), either)
    many = b"".join(_chunk(b"tEXt", b"k%d\0v" % n) for n in range(20_000))
    yield HostileFile("PNG: twenty thousand texts", _png(8, 8, many), either)
    whole = photo(6)
    comments = b"".join(b"\xff\xfe" + struct.pack(">H", 1002) + bytes(1000) for _ in range(400))
    yield HostileFile("JPEG: four hundred comments", whole[:2] + comments + whole[2:], either)
    flat = io.BytesIO()
    Image.new("RGB", (999, 999)).save(flat, "PNG")
    yield HostileFile("PNG: as many pixels as allowed in few bytes", flat.getvalue(), SUCCEEDED)
    frames = io.BytesIO()
    pictures = [photo_image(n, 16, 16) for n in range(200)]
    pictures[0].save(frames, "WEBP", save_all=True, append_images=pictures[1:], quality=1)
    yield HostileFile("WEBP: two hundred frames", frames.getvalue(), SUCCEEDED)
    pages = io.BytesIO()
    pictures[0].save(pages, "TIFF", save_all=True, append_images=pictures[1:])
    yield HostileFile("TIFF: two hundred pages", pages.getvalue(), SUCCEEDED)
    loop = bytearray(_tiff(8, 8))
    loop[8 + 2 + 7 * 12 : 8 + 2 + 7 * 12 + 4] = struct.pack("<I", 8)
    yield HostileFile("TIFF: a directory that leads to itself", bytes(loop), either)


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


def exif() -> Iterator[HostileFile]:
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
        yield HostileFile(f"EXIF: {what}", _with_exif(40 + number, block), SUCCEEDED)
    dice = random.Random(1)
    for seed in range(10):
        block = b"MM\0*\0\0\0\x08" + dice.randbytes(300)
        yield HostileFile(f"EXIF: noise {seed}", _with_exif(60 + seed, block), SUCCEEDED)
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
        yield HostileFile(
            f"EXIF: {top}/{bottom} degrees", _with_exif(75 + number, block), SUCCEEDED
        )


def names() -> Iterator[HostileFile]:
    names = (
        "../../../../etc/passwd",
        "..\\..\\windows\\system32\\photo.jpg",
        "/etc/cron.d/photo.jpg",
        "C:\\photo.jpg",
        "%2e%2e%2fphoto.jpg",
        "photo.jpg\r\nX-Evil: 1",
        "photo\u202egpj.exe",
        "<img src=x onerror=alert(1)>.jpg",
        "'; DROP TABLE photos; --.jpg",
        "{{7*7}}.jpg",
    )
    for number, name in enumerate(names):
        yield HostileFile(f"name {name[:30]!r}", photo(130 + number), SUCCEEDED, filename=name)
    too_long = frozenset({"malformed_body"})  # more than a part of a form may say of itself
    yield HostileFile("a name of 5000 letters", photo(149), too_long, filename="x" * 5000 + ".jpg")


def archives() -> Iterator[HostileFile]:
    members = {f"{n}.jpg": photo(200 + n) for n in range(3)}
    for name, data in (("zip", zip_of(members)), ("tar.gz", tar_of(members, "w:gz"))):
        yield HostileFile(f"an archive, {name}", data, NO_PHOTO, f"photos.{name}")
    yield HostileFile("a bomb in a zip", zip_of({"a.jpg": bytes(50_000_000)}), NO_PHOTO)


def corpus() -> list[HostileFile]:
    """All of them."""
    return [
        *of_another_kind(),
        *cut_off(),
        *huge(),
        *bombs(),
        *polyglots(),
        *exif(),
        *noise(),
        *names(),
        *archives(),
    ]
