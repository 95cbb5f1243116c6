"""Which archives are accepted: recognised by their first bytes, not by their names."""

from __future__ import annotations

from enum import StrEnum

ARCHIVE_SIGNATURE_BYTES = 512  # a tar's first header
ACCEPTED_ARCHIVES = "a zip, a tar or a gzipped tar"

TAR_CHECKSUM_FIELD = slice(
    148, 156
)  # of a tar's header: where the sum of its other bytes stands, in octal


class ArchiveFormat(StrEnum):
    ZIP = "zip"
    TAR = "tar"
    GZIP = "gzip"  # of a tar, one hopes: only unpacking tells


def detect_archive_format(first_bytes: bytes) -> ArchiveFormat | None:
    """The format by the first SNIFFED_ARCHIVE_BYTES; None for anything not accepted."""
    if first_bytes.startswith((b"PK\x03\x04", b"PK\x05\x06")):  # the second one: an empty zip
        return ArchiveFormat.ZIP
    if first_bytes.startswith(b"\x1f\x8b\x08"):
        return ArchiveFormat.GZIP
    return ArchiveFormat.TAR if is_tar_header(first_bytes[:ARCHIVE_SIGNATURE_BYTES]) else None


def is_tar_header(block: bytes) -> bool:
    """Is it a tar's header of 512 bytes, by its checksum? Not every tar has the word `ustar`."""
    if len(block) != ARCHIVE_SIGNATURE_BYTES:
        return False
    try:
        said = int(block[TAR_CHECKSUM_FIELD].strip(b"\0 ") or b"-1", 8)
    except ValueError:
        return False
    return said == sum(block) - sum(block[TAR_CHECKSUM_FIELD]) + 8 * ord(" ")
