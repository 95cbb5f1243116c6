"""What every kind of archive gives: members, and the bytes of each.

An object as a file of which each part is asked for anew.

Nothing is kept open between two reads: a batch that waits for the extractors may rest for hours in
the middle of an archive.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol, cast

from shared.errors import PlacewiseError, TooLarge, Unprocessable
from shared.storage import ObjectStore

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer


ARCHIVE_READ_BYTES = 256 * 1024


class MemberKind(StrEnum):
    FILE = "file"
    FOLDER = "folder"
    OTHER = "other"  # a link, a device, a part of something larger


@dataclass(frozen=True, slots=True)
class ArchiveMember:
    name: str
    """As the archive says it: any text."""
    kind: MemberKind
    offset: int
    """Where it begins in the archive (in the unpacked one, if that is gzipped), in bytes."""
    size_bytes: int
    """Unpacked, as it is declared."""
    packed_bytes: int
    method: int = 0
    """A zip's number of how it is packed; 0 is not at all."""
    crc32: int | None = None
    fault: PlacewiseError | None = None
    """Why it can't be read."""


@dataclass(frozen=True, slots=True)
class ArchiveLimits:
    members: int
    unpacked_bytes: int

    def check_members(self, count: int) -> None:
        """TooLarge (`too_many_photos_error`)."""
        if count > self.members:
            raise TooLarge(
                "too_many_photos",
                f"The archive has more than {self.members} members (MAX_BATCH_PHOTOS). Split it.",
            )

    def check_unpacked(self, size_bytes: int) -> None:
        """TooLarge (`batch_too_large_error`)."""
        if size_bytes > self.unpacked_bytes:
            raise TooLarge(
                "batch_too_large",
                f"Unpacked, the archive is larger than {self.unpacked_bytes} bytes "
                "(MAX_ARCHIVE_SIZE). Split it.",
            )


class Archive(Protocol):
    """Raises Unprocessable (`damaged_archive_error`, `damaged_member_error`) for what can't be
    read, and what
    the object store raises."""

    def members(self) -> Iterator[ArchiveMember]:
        """All of them, in the archive's order; TooLarge as `Limits` says."""

    def read(self, member: ArchiveMember) -> Iterator[bytes]:
        """The member's bytes in pieces of at most PIECE_BYTES, never more than it declares. Raises
        its `fault`."""


def damaged_archive_error(what: str) -> PlacewiseError:
    return Unprocessable(
        "damaged_archive", f"The archive can't be read: {what}. Make it anew and upload it again."
    )


def damaged_member_error(what: str) -> PlacewiseError:
    return Unprocessable("damaged_member", f"The archive's member can't be read: {what}.")


def unsupported_member_error(what: str) -> PlacewiseError:
    return Unprocessable(
        "unsupported_member", f"The archive's member is {what}, and no file of its own."
    )


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
