"""Readers for uploaded zip and tar archives in the object store, with `zipfile` and `tarfile`.

Archives are untrusted input: every size and count that an archive declares is checked against a
limit before it is used, and member names are labels only, never paths to write to. A member is
read by its offset, so that a batch continues after a restart without reading the archive from its
beginning (except a gzipped one).
"""

from __future__ import annotations

import contextlib
import gzip
import io
import stat
import tarfile
import zipfile
from collections.abc import Iterator
from typing import cast

from services.steward.archives.archive import (
    ARCHIVE_READ_BYTES,
    Archive,
    ArchiveLimits,
    ArchiveMember,
    BoundedFile,
    MemberKind,
    RangedFile,
    convert_read_errors,
    damaged_archive_error,
    damaged_member_error,
    unsupported_member_error,
)
from shared.errors import Gone, PlacewiseError, TooLarge, Unprocessable
from shared.imaging.file_formats import (
    ACCEPTED_ARCHIVES,
    ARCHIVE_SIGNATURE_BYTES,
    ArchiveFormat,
    detect_archive_format,
)
from shared.storage import ObjectStore

# The central directory is read into memory. Long names and comments fit with many members.
MIN_DIRECTORY_BYTES = 1024 * 1024
DIRECTORY_BYTES_PER_MEMBER = 256
ENCRYPTION_FLAGS = 0x0001 | 0x0040 | 0x2000  # APPNOTE.TXT 4.4.4
UTF8_FLAG = 0x0800
UNIX = 3


def open_archive(store: ObjectStore, key: str, limits: ArchiveLimits) -> Archive:
    """Open an archive of the object store; its format is detected from its content.

    Raises:
        Gone: `archive_gone`: the object does not exist.
        Unprocessable: `unsupported_archive`.
    """
    info = store.head(key)
    if info is None:
        raise Gone("archive_gone", "The archive is no longer in the object store. Upload it again.")
    archive_format = detect_archive_format(store.read_range(key, 0, ARCHIVE_SIGNATURE_BYTES))
    file = BoundedFile(RangedFile(store, key, info.size_bytes))
    if archive_format == ArchiveFormat.ZIP:
        return ZipArchive(file, info.size_bytes, limits)
    if archive_format in (ArchiveFormat.TAR, ArchiveFormat.GZIP):
        return _TarArchive(file, limits, gzipped=archive_format == ArchiveFormat.GZIP)
    raise Unprocessable(
        "unsupported_archive", f"The content of the file is not {ACCEPTED_ARCHIVES}."
    )


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
            yield _zip_member(info)

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


def _zip_member(info: zipfile.ZipInfo) -> ArchiveMember:
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


MAX_HEADER_BYTES = 1024 * 1024  # of a member, with its pax headers and long names


class _TarArchive:
    """A tar archive; see `Archive`."""

    def __init__(self, file: BoundedFile, limits: ArchiveLimits, *, gzipped: bool) -> None:
        if gzipped:
            file = BoundedFile(cast("io.RawIOBase", gzip.GzipFile(mode="rb", fileobj=file)))
        self._file = file
        self._gzipped = gzipped
        self._limits = limits

    def members(self) -> Iterator[ArchiveMember]:
        with convert_read_errors(damaged_archive_error):
            self._file.seek(0)
            with self._bounded_header():
                archive = tarfile.TarFile(
                    fileobj=cast("io.BytesIO", self._file), encoding="utf-8", errors="replace"
                )
        count = end = 0
        while True:
            # Checked before the next header, because a gzipped archive is decompressed up to there.
            self._limits.check_unpacked(archive.offset)
            with convert_read_errors(damaged_archive_error), self._bounded_header():
                info = archive.next()
            if info is None:
                break
            archive.members.clear()  # type: ignore[attr-defined]  # else it keeps them all
            count += 1
            self._limits.check_members(count)
            if info.size < 0 or archive.offset <= end:
                raise damaged_archive_error("a member declares a negative size")
            end = archive.offset
            yield _tar_member(info)
        self._verify_end(end)

    def read(self, member: ArchiveMember) -> Iterator[bytes]:
        if member.fault is not None:
            raise member.fault
        remaining = member.size_bytes
        with convert_read_errors(damaged_archive_error):
            self._file.seek(member.offset)
        while remaining:
            with convert_read_errors(damaged_archive_error):
                piece = self._file.read(min(ARCHIVE_READ_BYTES, remaining))
            if not piece:
                raise damaged_member_error("the archive is truncated")
            remaining -= len(piece)
            yield piece

    def _bounded_header(self) -> contextlib.AbstractContextManager[None]:
        return self._file.bounded(
            MAX_HEADER_BYTES,
            damaged_archive_error(f"a header is larger than {MAX_HEADER_BYTES} bytes"),
        )

    def _verify_end(self, position: int) -> None:
        """Check the block at the end, where `tarfile` also stops at a missing or damaged header.

        Reads a gzipped archive to its end, so that gzip verifies its checksum.
        """
        with convert_read_errors(damaged_archive_error):
            self._file.seek(position)
            block = self._file.read(tarfile.BLOCKSIZE)
            if len(block) < tarfile.BLOCKSIZE:
                raise damaged_archive_error("it is truncated: the end-of-archive block is missing")
            if any(block):
                raise damaged_archive_error(f"there is no header at byte {position}")
            while self._gzipped and (piece := self._file.read(ARCHIVE_READ_BYTES)):
                position += len(piece)
                self._limits.check_unpacked(position)


def _tar_member(info: tarfile.TarInfo) -> ArchiveMember:
    kind, description = MemberKind.OTHER, None
    if info.isdir() or (info.isreg() and info.name.endswith("/")):
        kind = MemberKind.FOLDER
    elif info.issym() or info.islnk():
        description = "a link"
    elif info.ischr() or info.isblk():
        description = "a device"
    elif info.isfifo():
        description = "a pipe"
    elif info.issparse():
        description = "a sparse file"
    elif info.isreg():
        kind = MemberKind.FILE
    else:
        description = f"of the unknown type {info.type!r}"
    return ArchiveMember(
        name=info.name,
        kind=kind,
        offset=info.offset_data,
        size_bytes=info.size,
        fault=unsupported_member_error(description) if description else None,
    )
