"""Zip archives (APPNOTE.TXT 6.3.10): the central directory first, then one member at a time.

Not by `zipfile`, which reads and keeps the whole directory before it can be asked how long it is: a
directory of 10 GB is a legal zip.
"""

from __future__ import annotations

import io
import stat
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

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
from shared.errors import PlacewiseError, Unprocessable

END = struct.Struct("<4s4H2LH")  # 4.3.16
END_SIGNATURE = b"PK\x05\x06"
LONGEST_COMMENT = 65_535
END_64_LOCATOR_BYTES = 20  # 4.3.15: stands before END
END_64 = struct.Struct("<4sQ2H2L4Q")  # 4.3.14: stands before its locator
END_64_SIGNATURE = b"PK\x06\x06"
ENTRY = struct.Struct("<4s6H3L5H2L")  # 4.3.12
ENTRY_SIGNATURE = b"PK\x01\x02"
LOCAL = struct.Struct("<4s5H3L2H")  # 4.3.7
LOCAL_SIGNATURE = b"PK\x03\x04"

IN_ZIP64 = 0xFFFF_FFFF  # 4.4.1.4: the value stands in the extra field
IN_ZIP64_SHORT = 0xFFFF
ZIP64 = 0x0001
ENCRYPTED = 0x0001 | 0x0040 | 0x2000  # 4.4.4
UNIX = 3
STORED, DEFLATED = 0, 8


@dataclass(frozen=True, slots=True)
class _Directory:
    begin: int
    size_bytes: int
    entries: int
    shift: int
    """What stands before the archive, as in one that unpacks itself: offsets don't count it."""


class ZipArchive:
    def __init__(self, file: io.BufferedReader, size_bytes: int, limits: Limits) -> None:
        self._file = file
        self._size_bytes = size_bytes
        self._limits = limits

    def members(self) -> Iterator[Member]:
        directory = self._find_directory()
        self._limits.check_members(directory.entries)
        position, end = directory.begin, directory.begin + directory.size_bytes
        count = packed = unpacked = 0
        while position < end:
            count += 1
            self._limits.check_members(count)
            self._file.seek(position)
            member, position = self._read_entry(position, directory.shift)
            packed += member.packed_bytes
            if packed > self._size_bytes:
                raise damaged_archive("its members overlap")
            unpacked += member.size_bytes
            self._limits.check_unpacked(unpacked)
            yield member

    def read(self, member: Member) -> Iterator[bytes]:
        if member.fault is not None:
            raise member.fault
        self._file.seek(member.offset)
        header = read_exactly(self._file, LOCAL.size)
        if len(header) < LOCAL.size or not header.startswith(LOCAL_SIGNATURE):
            raise damaged_member("it is not where the directory says")
        *_, name_bytes, extra_bytes = LOCAL.unpack(header)
        self._file.seek(member.offset + LOCAL.size + name_bytes + extra_bytes)
        size = crc = 0
        for piece in self._unpack(member):
            size += len(piece)
            if size > member.size_bytes:
                raise damaged_member(f"it unpacks to more than the {member.size_bytes} bytes said")
            crc = zlib.crc32(piece, crc)
            yield piece
        if size != member.size_bytes or crc != member.crc32:
            raise damaged_member("its size or checksum is not the one said")

    def _unpack(self, member: Member) -> Iterator[bytes]:
        left = member.packed_bytes
        inflater = zlib.decompressobj(-zlib.MAX_WBITS) if member.method == DEFLATED else None
        while left:
            packed = self._file.read(min(PIECE_BYTES, left))
            if not packed:
                raise damaged_member("the archive ends in the middle of it")
            left -= len(packed)
            if inflater is None:
                yield packed
                continue
            while packed and not inflater.eof:
                try:
                    yield inflater.decompress(packed, PIECE_BYTES)
                except zlib.error as error:
                    raise damaged_member(str(error)) from None
                packed = inflater.unconsumed_tail
        if inflater is not None:
            yield inflater.flush()  # at most the end of one match: all input was taken

    def _find_directory(self) -> _Directory:
        """4.3.1: its place stands at the end of the archive."""
        tail_begin = max(0, self._size_bytes - END.size - LONGEST_COMMENT)
        self._file.seek(tail_begin)
        tail = read_exactly(self._file, self._size_bytes - tail_begin)
        at = _find_end(tail)
        _, disk, _, _, entries, size_bytes, offset, _ = END.unpack_from(tail, at)
        end = tail_begin + at
        if IN_ZIP64_SHORT in (disk, entries) or IN_ZIP64 in (size_bytes, offset):
            begin_64 = end - END_64_LOCATOR_BYTES - END_64.size
            self._file.seek(max(0, begin_64))
            record = read_exactly(self._file, END_64.size)
            if record.startswith(END_64_SIGNATURE) and len(record) == END_64.size:
                end = begin_64
                *_, disk, _, _, entries, size_bytes, offset = END_64.unpack(record)
        if disk:
            raise damaged_archive("it is one part of several")
        shift = end - size_bytes - offset
        if shift < 0:
            raise damaged_archive("its directory is not where it says")
        return _Directory(end - size_bytes, size_bytes, entries, shift)

    def _read_entry(self, position: int, shift: int) -> tuple[Member, int]:
        """The directory's entry at the position, and where the next one begins."""
        header = read_exactly(self._file, ENTRY.size)
        if len(header) < ENTRY.size or not header.startswith(ENTRY_SIGNATURE):
            raise damaged_archive("its directory is broken")
        (_, made_by, _, flags, method, _, _, crc, packed, size, name_bytes, extra_bytes) = (
            ENTRY.unpack(header)[:12]
        )
        comment_bytes, _, _, attributes, offset = ENTRY.unpack(header)[12:]
        name = _text(read_exactly(self._file, name_bytes))
        extra = read_exactly(self._file, extra_bytes)
        size, packed, offset = _from_zip64(extra, size, packed, offset)
        mode = attributes >> 16 if made_by >> 8 == UNIX else 0
        kind = MemberKind.FOLDER if name.endswith("/") else MemberKind.FILE
        if stat.S_ISLNK(mode):
            kind = MemberKind.OTHER
        member = Member(
            name=name,
            kind=kind,
            offset=shift + offset,
            size_bytes=size,
            packed_bytes=packed,
            method=method,
            crc32=crc,
            fault=odd_member("a link") if stat.S_ISLNK(mode) else _fault(flags, method),
        )
        return member, position + ENTRY.size + name_bytes + extra_bytes + comment_bytes


def _find_end(tail: bytes) -> int:
    """Where END stands: its comment reaches to the archive's end, and may itself look like one."""
    last = at = tail.rfind(END_SIGNATURE, 0, len(tail) - END.size + len(END_SIGNATURE))
    while at >= 0:
        if at + END.size + END.unpack_from(tail, at)[-1] == len(tail):
            return at
        at = tail.rfind(END_SIGNATURE, 0, at)
    if last < 0:
        raise damaged_archive("its end, where a zip's directory stands, is missing")
    return last  # something was added to it


def _text(name: bytes) -> str:
    # Many zips hold UTF-8 without the flag that says so; 4.4.4 means code page 437 then.
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("cp437")


def _from_zip64(extra: bytes, size: int, packed: int, offset: int) -> tuple[int, int, int]:
    """4.5.3: those of the three values that did not fit into 32 bits."""
    while len(extra) >= 4:
        tag, length = struct.unpack_from("<2H", extra)
        values = iter(struct.unpack_from(f"<{length // 8}Q", extra[4 : 4 + length].ljust(length)))
        if tag == ZIP64:
            try:
                size = next(values) if size == IN_ZIP64 else size
                packed = next(values) if packed == IN_ZIP64 else packed
                offset = next(values) if offset == IN_ZIP64 else offset
            except StopIteration:
                raise damaged_archive("its directory is broken") from None
        extra = extra[4 + length :]
    return size, packed, offset


def _fault(flags: int, method: int) -> PlacewiseError | None:
    if flags & ENCRYPTED:
        return Unprocessable(
            "encrypted_member", "The archive's member is encrypted: pack it without a password."
        )
    if method not in (STORED, DEFLATED):
        return Unprocessable(
            "unsupported_member",
            f"The archive's member is packed by method {method}; Placewise reads what is stored or "
            "deflated, as every zip program can do.",
        )
    return None
