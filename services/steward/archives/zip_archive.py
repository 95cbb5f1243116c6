"""Reader for zip archives (APPNOTE.TXT 6.3.10): the central directory, then one member at a time.

The standard library's `zipfile` reads and keeps the whole central directory before its size can be
checked, and a directory of 10 GB is legal. This reader has constant memory. Section numbers in the
comments refer to APPNOTE.TXT.
"""

from __future__ import annotations

import io
import stat
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

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
from shared.errors import PlacewiseError, Unprocessable

END_RECORD = struct.Struct("<4s4H2LH")  # 4.3.16
END_SIGNATURE = b"PK\x05\x06"
MAX_COMMENT_BYTES = 65_535
LOCATOR_64_BYTES = 20  # 4.3.15: precedes END_RECORD
END_RECORD_64 = struct.Struct("<4sQ2H2L4Q")  # 4.3.14: precedes its locator
END_64_SIGNATURE = b"PK\x06\x06"
DIRECTORY_ENTRY = struct.Struct("<4s6H3L5H2L")  # 4.3.12
ENTRY_SIGNATURE = b"PK\x01\x02"
LOCAL_HEADER = struct.Struct("<4s5H3L2H")  # 4.3.7
LOCAL_SIGNATURE = b"PK\x03\x04"

ZIP64_SENTINEL = 0xFFFF_FFFF  # 4.4.1.4: the value is in the extra field
ZIP64_SENTINEL_16 = 0xFFFF
ZIP64_EXTRA_TAG = 0x0001
ENCRYPTION_FLAGS = 0x0001 | 0x0040 | 0x2000  # 4.4.4
UNIX = 3
STORED, DEFLATED = 0, 8


@dataclass(frozen=True, slots=True)
class _CentralDirectory:
    begin: int
    size_bytes: int
    entries: int
    offset_shift: int
    """Bytes before the archive, as in a self-extracting one: offsets don't include them."""


class ZipArchive:
    """A zip archive; see `Archive`."""

    def __init__(self, file: io.BufferedReader, size_bytes: int, limits: ArchiveLimits) -> None:
        self._file = file
        self._size_bytes = size_bytes
        self._limits = limits

    def members(self) -> Iterator[ArchiveMember]:
        directory = self._find_directory()
        self._limits.check_members(directory.entries)
        position, end = directory.begin, directory.begin + directory.size_bytes
        count = packed = unpacked = 0
        while position < end:
            count += 1
            self._limits.check_members(count)
            self._file.seek(position)
            member, position = self._read_entry(position, directory.offset_shift)
            packed += member.packed_bytes
            if packed > self._size_bytes:
                raise damaged_archive_error("its members overlap")
            unpacked += member.size_bytes
            self._limits.check_unpacked(unpacked)
            yield member

    def read(self, member: ArchiveMember) -> Iterator[bytes]:
        if member.fault is not None:
            raise member.fault
        self._file.seek(member.offset)
        header = read_exactly(self._file, LOCAL_HEADER.size)
        if len(header) < LOCAL_HEADER.size or not header.startswith(LOCAL_SIGNATURE):
            raise damaged_member_error("it is not at the offset in the central directory")
        *_, name_bytes, extra_bytes = LOCAL_HEADER.unpack(header)
        self._file.seek(member.offset + LOCAL_HEADER.size + name_bytes + extra_bytes)
        size = crc = 0
        for piece in self._unpack(member):
            size += len(piece)
            if size > member.size_bytes:
                raise damaged_member_error(
                    f"its content is larger than the declared {member.size_bytes} bytes"
                )
            crc = zlib.crc32(piece, crc)
            yield piece
        if size != member.size_bytes or crc != member.crc32:
            raise damaged_member_error("its size or checksum is not the declared one")

    def _unpack(self, member: ArchiveMember) -> Iterator[bytes]:
        remaining = member.packed_bytes
        inflater = zlib.decompressobj(-zlib.MAX_WBITS) if member.method == DEFLATED else None
        while remaining:
            packed = self._file.read(min(ARCHIVE_READ_BYTES, remaining))
            if not packed:
                raise damaged_member_error("the archive is truncated")
            remaining -= len(packed)
            if inflater is None:
                yield packed
                continue
            while packed and not inflater.eof:
                try:
                    yield inflater.decompress(packed, ARCHIVE_READ_BYTES)
                except zlib.error as error:
                    raise damaged_member_error(str(error)) from None
                packed = inflater.unconsumed_tail
        if inflater is not None:
            yield inflater.flush()  # at most the rest of one match: all input was consumed

    def _find_directory(self) -> _CentralDirectory:
        """Locate the central directory by the record at the end of the archive (4.3.1)."""
        tail_begin = max(0, self._size_bytes - END_RECORD.size - MAX_COMMENT_BYTES)
        self._file.seek(tail_begin)
        tail = read_exactly(self._file, self._size_bytes - tail_begin)
        at = _find_end_record(tail)
        _, disk, _, _, entries, size_bytes, offset, _ = END_RECORD.unpack_from(tail, at)
        end = tail_begin + at
        if ZIP64_SENTINEL_16 in (disk, entries) or ZIP64_SENTINEL in (size_bytes, offset):
            begin_64 = end - LOCATOR_64_BYTES - END_RECORD_64.size
            self._file.seek(max(0, begin_64))
            record = read_exactly(self._file, END_RECORD_64.size)
            if record.startswith(END_64_SIGNATURE) and len(record) == END_RECORD_64.size:
                end = begin_64
                *_, disk, _, _, entries, size_bytes, offset = END_RECORD_64.unpack(record)
        if disk:
            raise damaged_archive_error("it is one part of a split archive")
        shift = end - size_bytes - offset
        if shift < 0:
            raise damaged_archive_error("its central directory is not at the declared offset")
        return _CentralDirectory(end - size_bytes, size_bytes, entries, shift)

    def _read_entry(self, position: int, shift: int) -> tuple[ArchiveMember, int]:
        """Return the directory's entry at the position, and the position of the next one."""
        header = read_exactly(self._file, DIRECTORY_ENTRY.size)
        if len(header) < DIRECTORY_ENTRY.size or not header.startswith(ENTRY_SIGNATURE):
            raise damaged_archive_error("its central directory is malformed")
        (_, made_by, _, flags, method, _, _, crc, packed, size, name_bytes, extra_bytes) = (
            DIRECTORY_ENTRY.unpack(header)[:12]
        )
        comment_bytes, _, _, attributes, offset = DIRECTORY_ENTRY.unpack(header)[12:]
        name = _decode_name(read_exactly(self._file, name_bytes))
        extra = read_exactly(self._file, extra_bytes)
        size, packed, offset = _from_zip64(extra, size, packed, offset)
        mode = attributes >> 16 if made_by >> 8 == UNIX else 0
        kind = MemberKind.FOLDER if name.endswith("/") else MemberKind.FILE
        if stat.S_ISLNK(mode):
            kind = MemberKind.OTHER
        member = ArchiveMember(
            name=name,
            kind=kind,
            offset=shift + offset,
            size_bytes=size,
            packed_bytes=packed,
            method=method,
            crc32=crc,
            fault=unsupported_member_error("a link")
            if stat.S_ISLNK(mode)
            else _unsupported_reason(flags, method),
        )
        return member, position + DIRECTORY_ENTRY.size + name_bytes + extra_bytes + comment_bytes


def _find_end_record(tail: bytes) -> int:
    """Return the offset of END_RECORD, whose comment ends with the archive.

    The comment may itself contain the record's signature.
    """
    last = at = tail.rfind(END_SIGNATURE, 0, len(tail) - END_RECORD.size + len(END_SIGNATURE))
    while at >= 0:
        if at + END_RECORD.size + END_RECORD.unpack_from(tail, at)[-1] == len(tail):
            return at
        at = tail.rfind(END_SIGNATURE, 0, at)
    if last < 0:
        raise damaged_archive_error("it is truncated: the end of central directory is missing")
    return last  # data was appended to the archive


def _decode_name(name: bytes) -> str:
    # Many zips have UTF-8 names without the UTF-8 flag; by 4.4.4 that would be code page 437.
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("cp437")


def _from_zip64(extra: bytes, size: int, packed: int, offset: int) -> tuple[int, int, int]:
    """Replace the values that did not fit into 32 bits by those of the extra field (4.5.3)."""
    while len(extra) >= 4:
        tag, length = struct.unpack_from("<2H", extra)
        values = iter(struct.unpack_from(f"<{length // 8}Q", extra[4 : 4 + length].ljust(length)))
        if tag == ZIP64_EXTRA_TAG:
            try:
                size = next(values) if size == ZIP64_SENTINEL else size
                packed = next(values) if packed == ZIP64_SENTINEL else packed
                offset = next(values) if offset == ZIP64_SENTINEL else offset
            except StopIteration:
                raise damaged_archive_error("its central directory is malformed") from None
        extra = extra[4 + length :]
    return size, packed, offset


def _unsupported_reason(flags: int, method: int) -> PlacewiseError | None:
    if flags & ENCRYPTION_FLAGS:
        return Unprocessable(
            "encrypted_member",
            "The archive member is encrypted. Create the archive without a password.",
        )
    if method not in (STORED, DEFLATED):
        return Unprocessable(
            "unsupported_member",
            f"The archive member uses compression method {method}; only stored and deflated "
            "members are supported.",
        )
    return None
