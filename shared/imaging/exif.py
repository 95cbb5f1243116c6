"""Tags of EXIF and TIFF directories, of which only the requested ones are read.

Pillow reads and converts all values of a directory, whose number and sizes the file decides: one of
100 MB is 12 million fractions. Here a directory is one read, and so is each requested value, of at
most MAX_VALUE_BYTES. The format is TIFF 6.0, page 13, and BigTIFF.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from shared.imaging.bounded_reader import BoundedReader

MAX_ENTRIES = 65_535  # what TIFF can count; BigTIFF has more digits
MAX_VALUE_BYTES = 4096
ASCII, BYTES = 2, (1, 7)
RATIONALS = (5, 10)
# Letters of `struct` by type; those of rationals stand for numerator and denominator.
TYPES = {
    1: "B",
    ASCII: "s",
    3: "H",
    4: "I",
    5: "II",
    6: "b",
    7: "B",
    8: "h",
    9: "i",
    10: "ii",
    11: "f",
    12: "d",
    13: "I",
    16: "Q",
    17: "q",
    18: "Q",
}


class _Entry(NamedTuple):
    tag: int
    type: int
    length: int
    value_or_offset: bytes


class TiffBlock:
    """A TIFF file, or a block of EXIF, which has the same format."""

    def __init__(self, reader: BoundedReader) -> None:
        """Read the first bytes; ValueError if it is not TIFF."""
        head = reader.read(0, 8)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None or head[2:4] not in (b"*\0", b"\0*", b"+\0", b"\0+"):
            raise ValueError("the EXIF has no TIFF header")
        self._reader = reader
        self._order = order
        self._big = b"+" in head[2:4]
        self.first_offset: int = (
            self._unpack("Q", reader.read(8, 8)) if self._big else self._unpack("I", head[4:])
        )[0]

    def read_directory(
        self, offset: int, tags: Collection[int], max_value_bytes: int = MAX_VALUE_BYTES
    ) -> dict[int, Any]:
        """Read the given tags of the directory at `offset`.

        Returns:
            By tag: text, bytes, a number, or a tuple of several; None for a tag whose value is
            broken or oversized. Fractions are floats: 0/0 is not a number, and 1/0 infinite.

        Raises:
            ValueError: The directory is beyond the end.
        """
        values: dict[int, Any] = {}
        for entry in self._entries(offset, tags):
            value = self._value(entry, max_value_bytes)
            values[entry.tag] = values.get(entry.tag) if value is None else value
        return values

    def has_next_directory(self, offset: int) -> bool:
        """Return whether another directory follows, which is another picture of a TIFF file."""
        letter, entry_size = ("Q", 20) if self._big else ("H", 12)
        size = struct.calcsize(letter)
        (count,) = self._unpack(letter, self._reader.read(offset, size))
        return any(self._reader.read(offset + size + count * entry_size, 8 if self._big else 4))

    def read_bytes(self, offset: int, tag: int, max_bytes: int) -> bytes | None:
        """Read the bytes of a tag; None if it is missing or has more than `max_bytes`."""
        entry = next(self._entries(offset, (tag,)), None)
        return None if entry is None else self._data(entry, max_bytes)

    def _entries(self, offset: int, tags: Collection[int]) -> Iterator[_Entry]:
        count_letter, letters = ("Q", "HHQ8s") if self._big else ("H", "HHI4s")
        count_size = struct.calcsize(count_letter)
        (count,) = self._unpack(count_letter, self._reader.read(offset, count_size))
        size = struct.calcsize(self._order + letters)
        table = self._reader.read_available(offset + count_size, min(count, MAX_ENTRIES) * size)
        whole = table[: len(table) // size * size]
        for values in struct.iter_unpack(self._order + letters, whole):
            if values[0] in tags:
                yield _Entry(*values)

    def _value(self, entry: _Entry, max_bytes: int) -> Any:
        data = self._data(entry, max_bytes)
        if not data:
            return None
        if entry.type == ASCII:
            return data.removesuffix(b"\0").decode("latin-1")
        if entry.type in BYTES:
            return data
        numbers: tuple[float, ...] = self._unpack(TYPES[entry.type] * entry.length, data)
        if entry.type in RATIONALS:
            pairs = zip(numbers[::2], numbers[1::2], strict=True)
            numbers = tuple(n / d if d else math.inf * n for n, d in pairs)  # inf * 0 is nan
        return numbers[0] if len(numbers) == 1 else numbers

    def _data(self, entry: _Entry, max_bytes: int) -> bytes | None:
        size = entry.length * struct.calcsize(self._order + TYPES.get(entry.type, ""))
        if not 0 < size <= max_bytes:
            return None
        if size <= len(entry.value_or_offset):
            return entry.value_or_offset[:size]
        (offset,) = self._unpack("Q" if self._big else "I", entry.value_or_offset)
        data = self._reader.read_available(offset, size)
        return data if len(data) == size else None

    def _unpack(self, letters: str, data: bytes) -> tuple[Any, ...]:
        return struct.unpack(self._order + letters, data)
