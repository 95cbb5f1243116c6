"""An object as a file of which each part is asked for anew.

Nothing is kept open between two reads: a batch that waits for the extractors may rest for hours in
the middle of an archive.
"""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING, cast

from shared.objects import ObjectStore

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

RANGE_BUFFER_BYTES = 256 * 1024  # one request


class RangeReader(io.RawIOBase):
    """Seekable and unbuffered; `open_buffered` gives it a buffer."""

    def __init__(self, store: ObjectStore, key: str, size_bytes: int) -> None:
        super().__init__()
        self._store = store
        self._key = key
        self._size_bytes = size_bytes
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        begin = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size_bytes}
        self._position = max(0, begin[whence] + offset)
        return self._position

    def readinto(self, buffer: WriteableBuffer) -> int:
        view = memoryview(buffer).cast("B")
        wanted = min(len(view), self._size_bytes - self._position)
        if wanted <= 0:
            return 0
        piece = self._store.read_range(self._key, self._position, wanted)
        view[: len(piece)] = piece
        self._position += len(piece)
        return len(piece)


def open_buffered(store: ObjectStore, key: str, size_bytes: int) -> io.BufferedReader:
    """The object of that size, buffered."""
    return io.BufferedReader(
        cast("io.RawIOBase", RangeReader(store, key, size_bytes)), RANGE_BUFFER_BYTES
    )


def read_exactly(file: io.BufferedIOBase, size_bytes: int) -> bytes:
    """So many bytes, fewer only at the end."""
    data = b""
    while len(data) < size_bytes and (piece := file.read(size_bytes - len(data))):
        data += piece
    return data
