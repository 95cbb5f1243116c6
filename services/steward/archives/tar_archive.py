"""Reader for tar archives, plain or gzipped: POSIX ustar and pax, GNU long names and numbers.

The standard library's `tarfile` reads a header of any declared size into memory and keeps every
member. This reader has constant memory and checks declared sizes first.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from services.steward.archives.archive import (
    ARCHIVE_READ_BYTES,
    ArchiveLimits,
    ArchiveMember,
    MemberKind,
    damaged_archive_error,
    damaged_member_error,
    read_exactly,
    unsupported_member_error,
)
from shared.imaging.file_formats import is_tar_header

BLOCK_BYTES = 512
MAX_HEADER_BYTES = 1024 * 1024  # of a pax header or a long name
HEADERS_PER_MEMBER = 4

REGULAR_FILE_TYPES = b"0\x007"
TYPES_WITHOUT_DATA = {
    b"1": "a link",
    b"2": "a link",
    b"3": "a device",
    b"4": "a device",
    b"6": "a pipe",
}
FOLDER_TYPE, SPARSE_TYPE = b"5", b"S"
PAX_TYPE, PAX_GLOBAL_TYPE, GNU_LONG_NAME_TYPE, GNU_LONG_LINK_TYPE = b"x", b"g", b"L", b"K"


@dataclass(slots=True)
class _TarHeader:
    """The header of a member, with the pax records and the long name that precede it."""

    name: str
    type: bytes
    size_bytes: int
    pax: dict[str, str] = field(default_factory=dict)


class TarArchive:
    """A tar archive; see `Archive`."""

    def __init__(self, file: io.BufferedReader, limits: ArchiveLimits, *, gzipped: bool) -> None:
        self._file: io.BufferedIOBase = gzip.GzipFile(mode="rb", fileobj=file) if gzipped else file
        self._gzipped = gzipped
        self._limits = limits

    def members(self) -> Iterator[ArchiveMember]:
        position = count = headers = 0
        pax: dict[str, str] = {}
        long_name: str | None = None
        while (header := self._read_header(position)) is not None:
            headers += 1
            self._limits.check_members(headers // HEADERS_PER_MEMBER)
            data = position + BLOCK_BYTES
            position = data + _padded_to_block(header.size_bytes)
            # Checked before seeking, because a gzipped archive is decompressed up to there.
            self._limits.check_unpacked(position)
            if header.type == PAX_TYPE:
                pax = _parse_pax(self._read_text(header.size_bytes))
            elif header.type == GNU_LONG_NAME_TYPE:
                long_name = _decode_text(self._read_text(header.size_bytes))
            elif header.type not in (PAX_GLOBAL_TYPE, GNU_LONG_LINK_TYPE):
                count += 1
                self._limits.check_members(count)
                size = _pax_size(pax, header.size_bytes)
                position = data + _padded_to_block(size)
                self._limits.check_unpacked(position)
                header.name = pax.get("path") or long_name or header.name
                header.size_bytes, header.pax = size, pax
                yield _to_member(header, data)
                pax, long_name = {}, None
        if self._gzipped:
            self._verify_trailer(position)

    def read(self, member: ArchiveMember) -> Iterator[bytes]:
        if member.fault is not None:
            raise member.fault
        remaining = member.size_bytes
        with _as_damaged_archive():
            self._file.seek(member.offset)
        while remaining:
            with _as_damaged_archive():
                piece = self._file.read(min(ARCHIVE_READ_BYTES, remaining))
            if not piece:
                raise damaged_member_error("the archive is truncated")
            remaining -= len(piece)
            yield piece

    def _read_header(self, position: int) -> _TarHeader | None:
        """Return the header at the position; None at the archive's end-of-archive block."""
        with _as_damaged_archive():
            self._file.seek(position)
            block = read_exactly(self._file, BLOCK_BYTES)
        if len(block) < BLOCK_BYTES:
            raise damaged_archive_error("it is truncated: the end-of-archive block is missing")
        if not any(block):
            return None
        if not is_tar_header(block):
            raise damaged_archive_error(
                "it is not a tar archive"
                if position == 0
                else f"there is no header at byte {position}"
            )
        name = _decode_text(block[:100])
        if block[257:262] == b"ustar" and block[263:265] == b"00" and block[345] != 0:
            name = f"{_decode_text(block[345:500])}/{name}"
        header = _TarHeader(name, block[156:157], _parse_number(block[124:136]))
        if header.type == FOLDER_TYPE or header.type in TYPES_WITHOUT_DATA:
            header.size_bytes = 0  # no data follows, whatever size is declared
        return header

    def _verify_trailer(self, position: int) -> None:
        """Read to the end, so that gzip verifies its checksum."""
        with _as_damaged_archive():
            while piece := self._file.read(ARCHIVE_READ_BYTES):
                position += len(piece)
                self._limits.check_unpacked(position)

    def _read_text(self, size_bytes: int) -> bytes:
        if size_bytes > MAX_HEADER_BYTES:
            raise damaged_archive_error(f"it has a header of {size_bytes} bytes")
        with _as_damaged_archive():
            return read_exactly(self._file, size_bytes)


@contextmanager
def _as_damaged_archive() -> Iterator[None]:
    """Convert decompression errors into `damaged_archive_error`."""
    try:
        yield
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise damaged_archive_error(str(error)) from None


def _to_member(header: _TarHeader, data: int) -> ArchiveMember:
    kind, fault = MemberKind.FILE, None
    if header.type == FOLDER_TYPE or (
        header.name.endswith("/") and header.type in REGULAR_FILE_TYPES
    ):
        kind = MemberKind.FOLDER
    elif header.type in TYPES_WITHOUT_DATA:
        kind, fault = MemberKind.OTHER, unsupported_member_error(TYPES_WITHOUT_DATA[header.type])
    elif header.type == SPARSE_TYPE or any(name.startswith("GNU.sparse") for name in header.pax):
        kind, fault = MemberKind.OTHER, unsupported_member_error("a sparse file")
    elif header.type not in REGULAR_FILE_TYPES:
        kind, fault = (
            MemberKind.OTHER,
            unsupported_member_error(f"of the unknown type {header.type!r}"),
        )
    return ArchiveMember(
        name=header.name,
        kind=kind,
        offset=data,
        size_bytes=header.size_bytes,
        packed_bytes=header.size_bytes,
        fault=fault,
    )


def _padded_to_block(size_bytes: int) -> int:
    return -(-size_bytes // BLOCK_BYTES) * BLOCK_BYTES


def _decode_text(data: bytes) -> str:
    return data.split(b"\0", 1)[0].decode("utf-8", "replace")


def _parse_number(data: bytes) -> int:
    """Parse octal digits, or GNU's base-256 form for large numbers (first byte 0x80)."""
    if data[0] == 0x80:
        return int.from_bytes(data[1:], "big")
    try:
        number = int(data.strip(b"\0 ") or b"0", 8)
    except ValueError:
        number = -1
    if number < 0:
        raise damaged_archive_error(f"a member declares the invalid size {data!r}")
    return number


def _parse_pax(data: bytes) -> dict[str, str]:
    """Parse a sequence of `LENGTH KEY=VALUE\\n` records."""
    records = {}
    while data.strip(b"\0"):
        digits, blank, _ = data.partition(b" ")
        if not blank or not digits.isdigit() or not len(digits) + 3 <= int(digits) <= len(data):
            raise damaged_archive_error("a pax header is malformed")
        record, data = data[len(digits) + 1 : int(digits)], data[int(digits) :]
        key, _, value = record.rstrip(b"\n").partition(b"=")
        records[_decode_text(key)] = _decode_text(value)
    return records


def _pax_size(pax: dict[str, str], size_bytes: int) -> int:
    declared = pax.get("size")
    if declared is None:
        return size_bytes
    if not (declared.isascii() and declared.isdigit() and len(declared) < 20):
        raise damaged_archive_error(f"a member declares the invalid size {declared!r}")
    return int(declared)
