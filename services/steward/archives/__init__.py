"""Archives of strangers, read from the object store: what is in them, and one member at a time.

A member is found by its place alone, so that a batch goes on after a restart without reading the
archive from its begin (but for a gzipped one). Names are labels: nothing is ever written under one.
Whatever an archive declares is bounded before it is believed.

An archive of the object store, by its content.
"""

from __future__ import annotations

from services.steward.archives.archive import Archive, ArchiveLimits, ArchiveMember, open_buffered
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
    """Raises Gone (`archive_gone`) and Unprocessable (`unsupported_archive`)."""
    info = store.head(key)
    if info is None:
        raise Gone("archive_gone", "The archive is no longer in the object store. Upload it again.")
    found = detect_archive_format(store.read_range(key, 0, ARCHIVE_SIGNATURE_BYTES))
    file = open_buffered(store, key, info.size_bytes)
    if found == ArchiveFormat.ZIP:
        return ZipArchive(file, info.size_bytes, limits)
    if found in (ArchiveFormat.TAR, ArchiveFormat.GZIP):
        return TarArchive(file, limits, gzipped=found == ArchiveFormat.GZIP)
    raise Unprocessable("unsupported_archive", f"By its content this is not {ACCEPTED_ARCHIVES}.")


__all__ = ["Archive", "ArchiveLimits", "ArchiveMember", "open_archive"]
