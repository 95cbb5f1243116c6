"""Size, EXIF and XMP of a HEIC photo, without its decoder, which is optional.

A HEIC file is a tree of boxes (ISO/IEC 14496-12): each has a length, a name of four letters and
content. `meta` lists the items (ISO/IEC 23008-12): the image, its tiles, its EXIF; properties in
`iprp` give the size and the rotation. Each box and each entry of a list is a step of the reader;
inconsistent files raise ValueError.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from shared.imaging.bounded_reader import MAX_METADATA_BYTES, BoundedReader

HEVC = (b"hvc1", b"grid")  # a single image, or a grid of tiles as phones write it
XMP_TYPE = b"application/rdf+xml"
QUARTER_TURNS = 4
Extents = list[tuple[int, int]]
"""(offset, length) of the parts of an item"""


@dataclass(frozen=True, slots=True)
class _Box:
    name: bytes
    content: bytes


@dataclass(frozen=True, slots=True)
class HeicContent:
    """What the boxes of a HEIC photo say."""

    width: int
    """upright, of the primary image"""
    height: int
    exif: list[bytes | None]
    """TIFF blocks; None for one that is not read: it is too large, or not stored as an item"""
    xmp: list[bytes | None]
    picture: Extents
    """of the images and tiles; empty if one is not stored in the file itself"""


def read_heic(reader: BoundedReader) -> HeicContent:
    """Read the boxes of a HEIC photo.

    Raises ValueError if it has no primary image, or if it is not HEVC (AVIF, for example).
    """
    boxes = {box.name: box.content for box in _boxes(reader, _meta(reader))}
    pitm = boxes[b"pitm"]
    primary: int = struct.unpack_from(">H" if pitm[0] == 0 else ">I", pitm, 4)[0]
    kinds = dict(_kinds(reader, boxes[b"iinf"]))
    if kinds.get(primary) not in HEVC:
        raise ValueError("its primary picture is not HEVC")
    width, height = _upright_size(reader, boxes[b"iprp"], primary)
    stored = _extents(reader, boxes.get(b"iloc", b""))
    images = [stored.get(item, []) for item, kind in sorted(kinds.items()) if kind == b"hvc1"]
    blocks = {
        kind: [_item(reader, stored.get(item, [])) for item, each in kinds.items() if each == kind]
        for kind in (b"Exif", XMP_TYPE)
    }
    return HeicContent(
        width,
        height,
        [
            block and (block[4 + int.from_bytes(block[:4], "big") :] or None)
            for block in blocks[b"Exif"]
        ],
        blocks[XMP_TYPE],
        [extent for extents in images for extent in extents] if all(images) else [],
    )


def _meta(reader: BoundedReader) -> bytes:
    """Return the content of the top-level box `meta`."""
    offset = 0
    while len(head := reader.read_available(offset, 16)) >= 8:
        size, name = struct.unpack(">I4s", head[:8])
        begin = 8
        if size == 1 and len(head) == 16:
            size, begin = struct.unpack(">Q", head[8:])[0], 16
        if name == b"meta":
            if size < begin + 4:
                raise ValueError("its box meta has a wrong length")
            return reader.read(offset + begin + 4, size - begin - 4)  # after version and flags
        if size < begin:
            break  # 0: last box; otherwise broken
        offset += size
    raise ValueError("it has no box meta")


def _boxes(reader: BoundedReader, data: bytes) -> Iterator[_Box]:
    offset = 0
    while offset + 8 <= len(data):
        reader.step()
        size, name = struct.unpack_from(">I4s", data, offset)
        if size < 8 or offset + size > len(data):
            raise ValueError(f"its box {name!r} has a wrong length")
        yield _Box(name, data[offset + 8 : offset + size])
        offset += size


def _kinds(reader: BoundedReader, data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield item and type of each entry of `iinf`; the type of XMP is XMP_TYPE."""
    for box in _boxes(reader, data[6 if data[0] == 0 else 8 :]):
        version = box.content[0]
        if box.name == b"infe" and version >= 2:
            letters = ">HH4s" if version == 2 else ">IH4s"
            item, _, kind = struct.unpack_from(letters, box.content, 4)
            names = box.content[4 + struct.calcsize(letters) :].split(b"\0")  # item, content type
            yield item, XMP_TYPE if kind == b"mime" and XMP_TYPE in names[1:2] else kind


def _upright_size(reader: BoundedReader, data: bytes, item: int) -> tuple[int, int]:
    """Return width and height of an item after rotation, from `ispe` and `irot`."""
    parts = {box.name: box.content for box in _boxes(reader, data)}
    properties = list(_boxes(reader, parts[b"ipco"]))
    size: tuple[int, int] | None = None
    quarter_turns = 0
    for index in _properties_of(reader, parts[b"ipma"], item):
        if not 1 <= index <= len(properties):
            raise ValueError("a property of its picture is missing")
        box = properties[index - 1]
        if box.name == b"ispe":
            width, height = struct.unpack_from(">II", box.content, 4)
            size = (width, height)
        elif box.name == b"irot":
            quarter_turns += box.content[0] % QUARTER_TURNS
    if size is None:
        raise ValueError("its header has no size")
    return size if quarter_turns % 2 == 0 else (size[1], size[0])


def _properties_of(reader: BoundedReader, data: bytes, item: int) -> list[int]:
    """Return an item's property numbers, from 1, by `ipma`; 0 stands for none."""
    version, wide = data[0], data[3] & 1
    (entries,) = struct.unpack_from(">I", data, 4)
    offset = 8
    for _ in range(entries):
        reader.step()
        entry, count = struct.unpack_from(">HB" if version == 0 else ">IB", data, offset)
        offset += 3 if version == 0 else 5
        if entry == item:
            numbers = struct.unpack_from(f">{count}{'H' if wide else 'B'}", data, offset)
            return [index for n in numbers if (index := n & (0x7FFF if wide else 0x7F))]
        offset += count * (2 if wide else 1)
    return []


def _item(reader: BoundedReader, extents: Extents) -> bytes | None:
    """Return the bytes of an item; None if it has none in this file, or is too large."""
    if not 4 < sum(length for _, length in extents) <= MAX_METADATA_BYTES:
        return None
    parts = [reader.read_available(*extent) for extent in extents]
    is_whole = all(len(part) == length for part, (_, length) in zip(parts, extents, strict=True))
    return b"".join(parts) if is_whole else None


def _extents(reader: BoundedReader, data: bytes) -> dict[int, Extents]:
    """Return the extents of the items in the file, by `iloc`; empty for those elsewhere."""
    stored: dict[int, Extents] = {}
    if len(data) < 8:
        return stored
    version = data[0]
    offset_size, length_size = data[4] >> 4, data[4] & 15
    base_size, index_size = data[5] >> 4, data[5] & 15 if version else 0
    if not offset_size or not length_size:
        raise ValueError("its box iloc has fields of size zero")
    wide = version == 2
    (entries,) = struct.unpack_from(">I" if wide else ">H", data, 6)
    position = 10 if wide else 8

    def number(size: int) -> int:
        nonlocal position
        if position + size > len(data):
            raise ValueError("its box iloc is cut off")
        value = int.from_bytes(data[position : position + size], "big")
        position += size
        return value

    for _ in range(entries):
        reader.step()
        item = number(4 if wide else 2)
        method = number(2) & 15 if version else 0
        source, base, count = number(2), number(base_size), number(2)
        extents = []
        for _ in range(count):
            reader.step()
            number(index_size)
            extents.append((base + number(offset_size), number(length_size)))
        stored[item] = [] if method or source else extents
    return stored
