"""Which archives are accepted: recognised by their first bytes, not by their names."""

from __future__ import annotations

from enum import StrEnum

SNIFFED_ARCHIVE_BYTES = 512  # a tar's first header
ACCEPTED_ARCHIVES = "a zip, a tar or a gzipped tar"

CHECKSUM = slice(148, 156)  # of a tar's header: where the sum of its other bytes stands, in octal


class ArchiveFormat(StrEnum):
    ZIP = "zip"
    TAR = "tar"
    GZIP = "gzip"  # of a tar, one hopes: only unpacking tells


def sniff_archive(begin: bytes) -> ArchiveFormat | None:
    """The format by the first SNIFFED_ARCHIVE_BYTES; None for anything not accepted."""
    if begin.startswith((b"PK\x03\x04", b"PK\x05\x06")):  # the second one: an empty zip
        return ArchiveFormat.ZIP
    if begin.startswith(b"\x1f\x8b\x08"):
        return ArchiveFormat.GZIP
    return ArchiveFormat.TAR if is_tar_header(begin[:SNIFFED_ARCHIVE_BYTES]) else None


def is_tar_header(block: bytes) -> bool:
    """Is it a tar's header of 512 bytes, by its checksum? Not every tar has the word `ustar`."""
    if len(block) != SNIFFED_ARCHIVE_BYTES:
        return False
    try:
        said = int(block[CHECKSUM].strip(b"\0 ") or b"-1", 8)
    except ValueError:
        return False
    return said == sum(block) - sum(block[CHECKSUM]) + 8 * ord(" ")
