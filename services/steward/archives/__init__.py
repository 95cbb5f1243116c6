"""Readers for uploaded zip and tar archives in the object store.

Archives are untrusted input: every size and count that an archive declares is checked against a
limit before it is used, and member names are labels only, never paths to write to. A member is
read by its offset, so that a batch continues after a restart without reading the archive from its
beginning (except a gzipped one).
"""

from __future__ import annotations

from services.steward.archives.archive import (
    Archive,
    ArchiveLimits,
    ArchiveMember,
    BoundedFile,
    RangedFile,
)
from services.steward.archives.tar_archive import TarArchive
from services.steward.archives.zip_archive import ZipArchive
from shared.errors import Gone, Unprocessable
from shared.imaging.file_formats import (
    ACCEPTED_ARCHIVES,
    ARCHIVE_SIGNATURE_BYTES,
    ArchiveFormat,
    detect_archive_format,
)
from shared.storage import ObjectStore


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
        return TarArchive(file, limits, gzipped=archive_format == ArchiveFormat.GZIP)
    raise Unprocessable(
        "unsupported_archive", f"The content of the file is not {ACCEPTED_ARCHIVES}."
    )


__all__ = ["Archive", "ArchiveLimits", "ArchiveMember", "open_archive"]
