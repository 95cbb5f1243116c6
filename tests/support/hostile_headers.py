"""Photos whose headers cost a reader much more time than their bytes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

from tests.support.photos import photo_bytes

JPEG = photo_bytes(1)
MAX_META_BYTES = 4_000_000  # a larger box of a HEIC is refused for its size


def box(name: bytes, content: bytes) -> bytes:
    """A box of HEIC."""
    return struct.pack(">I4s", 8 + len(content), name) + content


def heic(iloc: bytes, *, version: int = 0, sizes: bytes = b"\x44\0", entries: int = 1) -> bytes:
    """A HEIC of 320 x 200 without pixels: item 1 is the picture, item 2 its EXIF.

    `iloc` has `entries` entries after its header; `sizes` are those of their fields.
    """
    items = b"".join(
        box(b"infe", b"\2\0\0\0" + struct.pack(">HH4s", number, 0, kind) + b"\0")
        for number, kind in ((1, b"hvc1"), (2, b"Exif"))
    )
    size = box(b"ipco", box(b"ispe", struct.pack(">III", 0, 320, 200)))
    of_item = box(b"ipma", struct.pack(">IIHBB", 0, 1, 1, 1, 1))
    header = (
        bytes([version, 0, 0, 0]) + sizes + struct.pack(">I" if version == 2 else ">H", entries)
    )
    meta = (
        bytes(4)
        + box(b"pitm", struct.pack(">IH", 0, 1))
        + box(b"iinf", struct.pack(">IH", 0, 2) + items)
        + box(b"iprp", size + of_item)
        + box(b"iloc", header + iloc)
    )
    return box(b"ftyp", b"heic\0\0\0\0mif1heic") + box(b"meta", meta)


def heic_of_endless_extents(size_bytes: int) -> bytes:
    """Each entry says that it has 65,535 extents, whose fields have no bytes."""
    entries = (min(size_bytes, MAX_META_BYTES) - len(heic(b"", version=2))) // 10
    iloc = struct.pack(">IHHH", 99, 0, 0, 65_535) * entries
    return heic(iloc, version=2, sizes=bytes(2), entries=entries)


def segment(marker: int, content: bytes) -> bytes:
    """A segment of JPEG."""
    return struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content


def jpeg(*segments: bytes) -> bytes:
    """A good JPEG of 64 x 48 with more segments before its own."""
    return JPEG[:2] + b"".join(segments) + JPEG[2:]


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of PNG."""
    length, checksum = struct.pack(">I", len(content)), zlib.crc32(kind + content)
    return length + kind + content + struct.pack(">I", checksum)


def png(*chunks: bytes) -> bytes:
    """A good PNG of 64 x 48 with more chunks before its pixels."""
    whole = photo_bytes(1, "PNG")
    return whole[:33] + b"".join(chunks) + whole[33:]


def webp(*chunks: tuple[bytes, bytes]) -> bytes:
    """A WebP of 64 x 48 without pixels, which says that it has EXIF."""
    size = struct.pack("<I", 0b1000) + (63).to_bytes(3, "little") + (47).to_bytes(3, "little")
    body = b"WEBP" + b"".join(
        kind + struct.pack("<I", len(content)) + content
        for kind, content in ((b"VP8X", size), *chunks)
    )
    return b"RIFF" + struct.pack("<I", len(body)) + body


def gps_of_many_values(entries: int, values: int) -> bytes:
    """A block of EXIF whose GPS directory has entries of many fractions, all of the same bytes."""
    fractions = struct.pack("<II", 1, 2) * values
    gps_at = 26 + len(fractions)
    directory = struct.pack("<HHHIIi", 1, 0x8825, 4, 1, gps_at, 0)
    table = b"".join(struct.pack("<HHII", tag, 5, values, 26) for tag in range(1, entries + 1))
    return (
        b"II*\0\x08\0\0\0" + directory + fractions + struct.pack("<H", entries) + table + bytes(4)
    )


def _repeated(make: Callable[..., bytes], part: bytes) -> Callable[[int], bytes]:
    return lambda size_bytes: make(part * (size_bytes // len(part)))


def _jpeg_with_gap(byte: bytes) -> Callable[[int], bytes]:
    return lambda size_bytes: jpeg(segment(0xFE, b"a comment"), byte * size_bytes)


def _heic_of_entries(size_bytes: int) -> bytes:
    entries = min(size_bytes, MAX_META_BYTES) // 18
    return heic(struct.pack(">IHHHII", 99, 0, 0, 1, 0, 0) * entries, version=2, entries=entries)


def _heic_of_boxes(size_bytes: int) -> bytes:
    return box(b"ftyp", b"heic\0\0\0\0") + box(b"free", b"") * (size_bytes // 8)


def _webp_of_chunks(size_bytes: int) -> bytes:
    return webp(*[(b"ABCD", b"")] * (size_bytes // 8))


# By name: make a photo of about so many bytes, which has as many parts as fit.
MANY_PARTS: dict[str, Callable[[int], bytes]] = {
    "JPEG: EXIF segments": _repeated(jpeg, segment(0xE1, b"Exif\0\0" + bytes(100))),
    "JPEG: comments": _repeated(jpeg, segment(0xFE, b"")),
    "JPEG: fill bytes": _jpeg_with_gap(b"\xff"),
    "JPEG: bytes between segments": _jpeg_with_gap(b"\0"),
    "PNG: texts": _repeated(png, chunk(b"tEXt", b"k\0")),
    "PNG: colour profiles": _repeated(
        png, chunk(b"iCCP", b"a\0\0" + zlib.compress(bytes(100_000), 9))
    ),
    "PNG: unknown chunks": _repeated(png, chunk(b"abCd", b"")),
    "HEIC: extents without bytes": heic_of_endless_extents,
    "HEIC: entries": _heic_of_entries,
    "HEIC: boxes": _heic_of_boxes,
    "WebP: chunks": _webp_of_chunks,
}
