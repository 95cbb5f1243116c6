"""Photos that say, or unpack to, more than anybody wants."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator

from PIL import Image

from tests.support.hostile.file import BROKEN, FINE, TOO_LARGE, Hostile, photo
from tests.support.photos import photo_image


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


def huge() -> Iterator[Hostile]:
    large = {
        "PNG": (_png, [(2**31 - 1, 2**31 - 1), (100_000, 100_000), (1, 2**31 - 1)]),
        "JPEG": (_jpeg, [(65_500, 65_500), (65_500, 16), (2000, 2000)]),
        "BMP": (_bmp, [(2**31 - 1, 2**31 - 1), (100_000, 100_000), (2000, -2000)]),
        "WEBP": (_webp, [(16_383, 16_383), (2**24, 2**24), (2000, 2000)]),
        "TIFF": (_tiff, [(2**32 - 1, 2**32 - 1), (100_000, 100_000), (2000, 2000)]),
    }
    for media, (make, sizes) in large.items():
        for width, height in sizes:
            yield Hostile(f"{media} of {width} x {height}", make(width, height), TOO_LARGE)
    yield Hostile("PNG of 0 x 0", _png(0, 0), BROKEN)
    yield Hostile("BMP of 0 x 0", _bmp(0, 0), BROKEN)
    yield Hostile("TIFF of 0 x 0", _tiff(0, 0), BROKEN)
    yield Hostile("PNG with fewer pixels than it says", _png(900, 900), BROKEN)
    yield Hostile("TIFF with fewer pixels than it says", _tiff(900, 900), BROKEN)


def bombs() -> Iterator[Hostile]:
    packed = zlib.compress(bytes(80_000_000), 9)
    may = BROKEN | FINE
    yield Hostile("PNG: text bomb", _png(8, 8, _chunk(b"zTXt", b"a\0\0" + packed)), may)
    international = _chunk(b"iTXt", b"a\0\x01\0\0\0" + packed)
    yield Hostile("PNG: international text bomb", _png(8, 8, international), may)
    yield Hostile("PNG: profile bomb", _png(8, 8, _chunk(b"iCCP", b"a\0\0" + packed)), may)
    pixels = _chunk(b"IDAT", packed)
    yield Hostile("PNG: more pixels than it says", _png(8, 8, pixels), may)
    many = b"".join(_chunk(b"tEXt", b"k%d\0v" % n) for n in range(20_000))
    yield Hostile("PNG: twenty thousand texts", _png(8, 8, many), may)
    whole = photo(6)
    comments = b"".join(b"\xff\xfe" + struct.pack(">H", 1002) + bytes(1000) for _ in range(400))
    yield Hostile("JPEG: four hundred comments", whole[:2] + comments + whole[2:], may)
    flat = io.BytesIO()
    Image.new("RGB", (999, 999)).save(flat, "PNG")
    yield Hostile("PNG: as many pixels as allowed in few bytes", flat.getvalue(), FINE)
    frames = io.BytesIO()
    pictures = [photo_image(n, 16, 16) for n in range(200)]
    pictures[0].save(frames, "WEBP", save_all=True, append_images=pictures[1:], quality=1)
    yield Hostile("WEBP: two hundred frames", frames.getvalue(), FINE)
    pages = io.BytesIO()
    pictures[0].save(pages, "TIFF", save_all=True, append_images=pictures[1:])
    yield Hostile("TIFF: two hundred pages", pages.getvalue(), FINE)
    loop = bytearray(_tiff(8, 8))
    loop[8 + 2 + 7 * 12 : 8 + 2 + 7 * 12 + 4] = struct.pack("<I", 8)
    yield Hostile("TIFF: a directory that leads to itself", bytes(loop), may)
