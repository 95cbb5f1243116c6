"""Tar archives, plain or gzipped: POSIX ustar and pax, GNU's long names and numbers.

Not by `tarfile`, which reads a header of any declared size into memory and keeps every member.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from services.steward.archives.member import (
    PIECE_BYTES,
    Limits,
    Member,
    MemberKind,
    damaged_archive,
    damaged_member,
    odd_member,
)
from services.steward.archives.ranged import read_exactly
from shared.archive_formats import is_tar_header

BLOCK_BYTES = 512
MAX_HEADER_BYTES = 1024 * 1024  # of a pax header or a long name
HEADERS_PER_MEMBER = 4

FILE_TYPES = b"0\x007"
WITHOUT_DATA = {b"1": "a link", b"2": "a link", b"3": "a device", b"4": "a device", b"6": "a pipe"}
FOLDER, SPARSE = b"5", b"S"
PAX, PAX_FOR_ALL, LONG_NAME, LONG_LINK = b"x", b"g", b"L", b"K"


@dataclass(slots=True)
class _Header:
    """One header, with what the ones before it said of its member."""

    name: str
    type: bytes
    size_bytes: int
    pax: dict[str, str] = field(default_factory=dict)


class TarArchive:
    def __init__(self, file: io.BufferedReader, limits: Limits, *, gzipped: bool) -> None:
        self._file: io.BufferedIOBase = gzip.GzipFile(mode="rb", fileobj=file) if gzipped else file
        self._gzipped = gzipped
        self._limits = limits

    def members(self) -> Iterator[Member]:
        position = count = headers = 0
        pax: dict[str, str] = {}
        long_name: str | None = None
        while (header := self._read_header(position)) is not None:
            headers += 1
            self._limits.check_members(headers // HEADERS_PER_MEMBER)
            data = position + BLOCK_BYTES
            position = data + _in_blocks(header.size_bytes)
            # Before seeking there: of a gzipped archive that means unpacking up to there.
            self._limits.check_unpacked(position)
            if header.type == PAX:
                pax = _read_pax(self._read_text(header.size_bytes))
            elif header.type == LONG_NAME:
                long_name = _text(self._read_text(header.size_bytes))
            elif header.type not in (PAX_FOR_ALL, LONG_LINK):
                count += 1
                self._limits.check_members(count)
                size = _pax_size(pax, header.size_bytes)
                position = data + _in_blocks(size)
                self._limits.check_unpacked(position)
                header.name = pax.get("path") or long_name or header.name
                header.size_bytes, header.pax = size, pax
                yield _member(header, data)
                pax, long_name = {}, None
        if self._gzipped:
            self._read_to_the_end(position)

    def read(self, member: Member) -> Iterator[bytes]:
        if member.fault is not None:
            raise member.fault
        left = member.size_bytes
        with _explained():
            self._file.seek(member.offset)
        while left:
            with _explained():
                piece = self._file.read(min(PIECE_BYTES, left))
            if not piece:
                raise damaged_member("the archive ends in the middle of it")
            left -= len(piece)
            yield piece

    def _read_header(self, position: int) -> _Header | None:
        """The header at the position; None at the archive's end mark."""
        with _explained():
            self._file.seek(position)
            block = read_exactly(self._file, BLOCK_BYTES)
        if len(block) < BLOCK_BYTES:
            raise damaged_archive("it ends in the middle, without a tar's end mark")
        if not any(block):
            return None
        if not is_tar_header(block):
            raise damaged_archive(
                "it is not a tar" if position == 0 else f"at byte {position} there is no header"
            )
        name = _text(block[:100])
        if block[257:262] == b"ustar" and block[263:265] == b"00" and block[345] != 0:
            name = f"{_text(block[345:500])}/{name}"
        header = _Header(name, block[156:157], _number(block[124:136]))
        if header.type == FOLDER or header.type in WITHOUT_DATA:
            header.size_bytes = 0  # whatever it says, none follows
        return header

    def _read_to_the_end(self, position: int) -> None:
        """Behind the end mark, where a gzip's checksum stands."""
        with _explained():
            while piece := self._file.read(PIECE_BYTES):
                position += len(piece)
                self._limits.check_unpacked(position)

    def _read_text(self, size_bytes: int) -> bytes:
        if size_bytes > MAX_HEADER_BYTES:
            raise damaged_archive(f"a header of {size_bytes} bytes")
        with _explained():
            return read_exactly(self._file, size_bytes)


@contextmanager
def _explained() -> Iterator[None]:
    """Turns what unpacking raises into `damaged_archive`."""
    try:
        yield
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise damaged_archive(str(error)) from None


def _member(header: _Header, data: int) -> Member:
    kind, fault = MemberKind.FILE, None
    if header.type == FOLDER or (header.name.endswith("/") and header.type in FILE_TYPES):
        kind = MemberKind.FOLDER
    elif header.type in WITHOUT_DATA:
        kind, fault = MemberKind.OTHER, odd_member(WITHOUT_DATA[header.type])
    elif header.type == SPARSE or any(name.startswith("GNU.sparse") for name in header.pax):
        kind, fault = MemberKind.OTHER, odd_member("a sparse file")
    elif header.type not in FILE_TYPES:
        kind, fault = MemberKind.OTHER, odd_member(f"of the unknown type {header.type!r}")
    return Member(
        name=header.name,
        kind=kind,
        offset=data,
        size_bytes=header.size_bytes,
        packed_bytes=header.size_bytes,
        fault=fault,
    )


def _in_blocks(size_bytes: int) -> int:
    return -(-size_bytes // BLOCK_BYTES) * BLOCK_BYTES


def _text(data: bytes) -> str:
    return data.split(b"\0", 1)[0].decode("utf-8", "replace")


def _number(data: bytes) -> int:
    """Octal digits; or, GNU's way for what is larger, bytes behind one with the highest bit."""
    if data[0] == 0x80:
        return int.from_bytes(data[1:], "big")
    try:
        number = int(data.strip(b"\0 ") or b"0", 8)
    except ValueError:
        number = -1
    if number < 0:
        raise damaged_archive(f"a member says that its size is {data!r}")
    return number


def _read_pax(data: bytes) -> dict[str, str]:
    """`LENGTH KEY=VALUE\\n`, again and again."""
    found = {}
    while data.strip(b"\0"):
        digits, blank, _ = data.partition(b" ")
        if not blank or not digits.isdigit() or not len(digits) + 3 <= int(digits) <= len(data):
            raise damaged_archive("a pax header is broken")
        record, data = data[len(digits) + 1 : int(digits)], data[int(digits) :]
        key, _, value = record.rstrip(b"\n").partition(b"=")
        found[_text(key)] = _text(value)
    return found


def _pax_size(pax: dict[str, str], size_bytes: int) -> int:
    said = pax.get("size")
    if said is None:
        return size_bytes
    if not (said.isascii() and said.isdigit() and len(said) < 20):
        raise damaged_archive(f"a member says that its size is {said!r}")
    return int(said)
