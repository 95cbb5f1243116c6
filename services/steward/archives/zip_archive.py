"""Reader for zip archives, with `zipfile`."""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Iterator

from services.steward.archives.archive import (
    ARCHIVE_READ_BYTES,
    ArchiveLimits,
    ArchiveMember,
    BoundedFile,
    MemberKind,
    convert_read_errors,
    damaged_archive_error,
    damaged_member_error,
    unsupported_member_error,
)
from shared.errors import PlacewiseError, TooLarge, Unprocessable

# The central directory is read into memory. Long names and comments fit with many members.
MIN_DIRECTORY_BYTES = 1024 * 1024
DIRECTORY_BYTES_PER_MEMBER = 256
ENCRYPTION_FLAGS = 0x0001 | 0x0040 | 0x2000  # APPNOTE.TXT 4.4.4
UTF8_FLAG = 0x0800
UNIX = 3


class ZipArchive:
    """A zip archive; see `Archive`."""

    def __init__(self, file: BoundedFile, size_bytes: int, limits: ArchiveLimits) -> None:
        self._file = file
        self._size_bytes = size_bytes
        self._limits = limits
        self._opened: tuple[zipfile.ZipFile, dict[int, zipfile.ZipInfo]] | None = None

    def members(self) -> Iterator[ArchiveMember]:
        infos = self._open()[0].infolist()
        self._limits.check_members(len(infos))
        packed = unpacked = 0
        for info in infos:
            packed += info.compress_size
            if packed > self._size_bytes:
                raise damaged_archive_error("its members overlap")
            unpacked += info.file_size
            self._limits.check_unpacked(unpacked)
            yield _to_member(info)

    def read(self, member: ArchiveMember) -> Iterator[bytes]:
        if member.fault is not None:
            raise member.fault
        archive, infos = self._open()
        if member.offset not in infos:
            raise damaged_member_error("it is not in the directory of the archive")
        size = 0
        with convert_read_errors(damaged_member_error):
            file = archive.open(infos[member.offset])
        while True:
            with convert_read_errors(damaged_member_error):
                piece = file.read(ARCHIVE_READ_BYTES)
            if not piece:
                break
            size += len(piece)
            yield piece
        if size != member.size_bytes:
            raise damaged_member_error(f"it has {size} bytes, but declares {member.size_bytes}")

    def _open(self) -> tuple[zipfile.ZipFile, dict[int, zipfile.ZipInfo]]:
        """Return the archive, opened once, and its members by offset."""
        if self._opened is None:
            max_bytes = MIN_DIRECTORY_BYTES + DIRECTORY_BYTES_PER_MEMBER * self._limits.members
            too_large = TooLarge(
                "too_many_photos",
                f"The directory of the archive is larger than {max_bytes} bytes, the limit for "
                f"{self._limits.members} members (MAX_BATCH_PHOTOS). Split it.",
            )
            with (
                convert_read_errors(damaged_archive_error),
                self._file.bounded(max_bytes, too_large),
            ):
                archive = zipfile.ZipFile(self._file)
            self._opened = archive, {info.header_offset: info for info in archive.infolist()}
        return self._opened


def _to_member(info: zipfile.ZipInfo) -> ArchiveMember:
    is_link = info.create_system == UNIX and stat.S_ISLNK(info.external_attr >> 16)
    kind = MemberKind.FOLDER if info.is_dir() else MemberKind.FILE
    return ArchiveMember(
        name=_decoded_name(info),
        kind=MemberKind.OTHER if is_link else kind,
        offset=info.header_offset,
        size_bytes=info.file_size,
        fault=unsupported_member_error("a link") if is_link else _unsupported_reason(info),
    )


def _decoded_name(info: zipfile.ZipInfo) -> str:
    # Many zips have UTF-8 names without the flag; by APPNOTE.TXT 4.4.4 that is code page 437.
    if not info.flag_bits & UTF8_FLAG:
        try:
            return info.filename.encode("cp437").decode("utf-8")
        except UnicodeDecodeError:
            pass
    return info.filename


def _unsupported_reason(info: zipfile.ZipInfo) -> PlacewiseError | None:
    if info.flag_bits & ENCRYPTION_FLAGS:
        return Unprocessable(
            "encrypted_member",
            "The archive member is encrypted. Create the archive without a password.",
        )
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return Unprocessable(
            "unsupported_member",
            f"The archive member uses compression method {info.compress_type}; only stored and "
            "deflated members are supported.",
        )
    return None
