"""Random reads of an untrusted file, with a limit of the work that reading its header may cost.

A parser that takes every length, count and offset from this reader ends after MAX_STEPS, whatever
the file says. That needs no clock and no child process: Python can't interrupt a thread that
computes, and a process for each header would cost more than the header.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import count
from typing import BinaryIO

# Of all parts of a header together: boxes, segments, chunks, entries. A photo of 200 megapixels in
# HEIC has some 800 tiles and about 5,000 steps; 20,000 take some 50 ms.
MAX_STEPS = 20_000
MAX_READ_BYTES = 4 * 1024 * 1024  # of one read
MAX_METADATA_BYTES = 1024 * 1024  # of EXIF or XMP; larger ones are left out
# Shorter gaps are read, because a seek in an object of an S3 store costs a request.
MAX_READ_GAP_BYTES = 1024 * 1024
MAX_OFFSET = 2**62  # files are smaller, and can't seek much further


class BoundedReader:
    """Reads parts of a file; each part is a step, and all of them together are limited."""

    def __init__(self, file: BinaryIO, steps: Iterator[int] | None = None) -> None:
        self._file = file
        self._position = file.seek(0)
        self._steps = steps or count(1)

    def of_part(self, data: bytes) -> BoundedReader:
        """Return a reader of a part that was read; its steps count as those of this one."""
        return BoundedReader(io.BytesIO(data), self._steps)

    def step(self) -> None:
        """Count a step of a loop that reads nothing.

        Raises:
            ValueError: The header has more than MAX_STEPS parts.
        """
        if next(self._steps) > MAX_STEPS:
            raise ValueError(f"its header has more than {MAX_STEPS} parts")

    def read(self, offset: int, size: int) -> bytes:
        """Read exactly `size` bytes.

        Raises:
            ValueError: The file is cut off, `size` exceeds MAX_READ_BYTES, or too many steps.
        """
        data = self.read_available(offset, size)
        if len(data) < size:
            raise ValueError("its header is cut off")
        return data

    def read_available(self, offset: int, size: int) -> bytes:
        """Read `size` bytes, or fewer at the end of the file; raises ValueError as `read` does."""
        self.step()
        if size > MAX_READ_BYTES:
            raise ValueError(f"a part of its header is larger than {MAX_READ_BYTES} bytes")
        if offset > MAX_OFFSET:
            return b""
        gap = offset - self._position
        if 0 < gap <= MAX_READ_GAP_BYTES:
            self._position += len(self._file.read(gap))
        elif gap:
            self._position = self._file.seek(offset)
        data = self._file.read(size)
        self._position += len(data)
        return data
