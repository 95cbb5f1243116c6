"""What every kind of archive gives: members, and the bytes of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from shared.errors import PlacewiseError, TooLarge, Unprocessable

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
    """Raises Unprocessable (`damaged_archive_error`, `damaged_member_error`) for what can't be read, and what
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
