"""Reader for tar archives, plain or gzipped, with `tarfile`."""

from __future__ import annotations

import contextlib
import gzip
import io
import tarfile
from collections.abc import Iterator
from typing import cast

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

MAX_HEADER_BYTES = 1024 * 1024  # of a member, with its pax headers and long names


class TarArchive:
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
            yield _to_member(info)
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


def _to_member(info: tarfile.TarInfo) -> ArchiveMember:
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
