"""The interface of archive readers, their limits and errors, and a seekable file over an object.

Each read is a range request of its own; no connection stays open between two reads, because a batch
that waits for the extractors may pause for hours in the middle of an archive.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import math
import os
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

from shared.errors import PlacewiseError, TooLarge, Unprocessable
from shared.storage import ObjectStore

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer


ARCHIVE_READ_BYTES = 256 * 1024

# What the standard library raises for content that it can't read.
READ_ERRORS = (
    EOFError,
    RuntimeError,
    ValueError,
    gzip.BadGzipFile,
    struct.error,
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
)


class MemberKind(StrEnum):
    FILE = "file"
    FOLDER = "folder"
    OTHER = "other"  # a link, a device, a sparse file


@dataclass(frozen=True, slots=True)
class ArchiveMember:
    """An entry of an archive."""

    name: str
    """As stored in the archive: any text."""
    kind: MemberKind
    offset: int
    """Its start in the archive (in the decompressed one, if it is gzipped), in bytes."""
    size_bytes: int
    """Declared size, uncompressed."""
    fault: PlacewiseError | None = None
    """Why it can't be read."""


@dataclass(frozen=True, slots=True)
class ArchiveLimits:
    """Limits on the number of members and on their total uncompressed size."""

    members: int
    unpacked_bytes: int

    def check_members(self, count: int) -> None:
        """Raise TooLarge (`too_many_photos`) above the limit."""
        if count > self.members:
            raise TooLarge(
                "too_many_photos",
                f"The archive has more than {self.members} members (MAX_BATCH_PHOTOS). Split it.",
            )

    def check_unpacked(self, size_bytes: int) -> None:
        """Raise TooLarge (`batch_too_large`) above the limit."""
        if size_bytes > self.unpacked_bytes:
            raise TooLarge(
                "batch_too_large",
                f"The uncompressed archive is larger than {self.unpacked_bytes} bytes "
                "(MAX_ARCHIVE_SIZE). Split it.",
            )


class Archive(Protocol):
    """Interface of archive readers.

    Both methods raise Unprocessable (`damaged_archive`, `damaged_member`) for content that can't be
    read, and the errors of the object store.
    """

    def members(self) -> Iterator[ArchiveMember]:
        """Yield all members in the archive's order; TooLarge as `ArchiveLimits` raises."""

    def read(self, member: ArchiveMember) -> Iterator[bytes]:
        """Yield the member's bytes in pieces of at most ARCHIVE_READ_BYTES.

        Never yields more bytes than the member declares. Raises its `fault`, if it has one.
        """


def damaged_archive_error(reason: str) -> PlacewiseError:
    return Unprocessable(
        "damaged_archive",
        f"The archive can't be read: {reason}. Create it again, then upload it again.",
    )


def damaged_member_error(reason: str) -> PlacewiseError:
    return Unprocessable("damaged_member", f"The archive member can't be read: {reason}.")


def unsupported_member_error(description: str) -> PlacewiseError:
    return Unprocessable(
        "unsupported_member", f"The archive member is {description}, not a regular file."
    )


@contextlib.contextmanager
def convert_read_errors(to_error: Callable[[str], PlacewiseError]) -> Iterator[None]:
    """Convert the standard library's errors inside the block with `to_error`."""
    try:
        yield
    except READ_ERRORS as error:
        raise to_error(str(error)) from None


BUFFER_BYTES = 256 * 1024  # bytes per request


class RangedFile(io.RawIOBase):
    """Seekable, unbuffered file over an object; each read is a range request."""

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
        size = min(len(view), self._size_bytes - self._position)
        if size <= 0:
            return 0
        piece = self._store.read_range(self._key, self._position, size)
        view[: len(piece)] = piece
        self._position += len(piece)
        return len(piece)


class BoundedFile(io.BufferedReader):
    """Buffered file of which no more than a limit is read inside `bounded`.

    `zipfile` and `tarfile` read a directory or a header of any declared size into memory.
    """

    def __init__(self, raw: io.RawIOBase) -> None:
        super().__init__(raw, BUFFER_BYTES)
        self._remaining: float = math.inf
        self._error: PlacewiseError | None = None

    @contextlib.contextmanager
    def bounded(self, max_bytes: int, error: PlacewiseError) -> Iterator[None]:
        """Raise the error when more than `max_bytes` are read inside the block."""
        self._remaining, self._error = max_bytes, error
        try:
            yield
        finally:
            self._remaining, self._error = math.inf, None

    def read(self, size: int | None = -1, /) -> bytes:
        if self._error is None:
            return super().read(size)
        allowed = int(self._remaining) + 1
        data = super().read(allowed if size is None or size < 0 else min(size, allowed))
        self._remaining -= len(data)
        if self._remaining < 0:
            raise self._error
        return data
