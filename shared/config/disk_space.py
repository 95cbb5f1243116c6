"""Free disk space: a reserve file for the catalog, and the check before bytes are accepted.

The reserve (`DiskReserve`): SQLite can't even delete rows on a full disk. A file of RESERVE_BYTES
beside the catalog is deleted when the disk is full, so that the server starts and photos can be
deleted, and is written again once there is enough space.

The check (`DiskSpace`): uploads, batches and other requests that create jobs need MIN_FREE_BYTES,
a query photo needs QUERY_SHARE of that, and the object store leaves the last RESERVED_FREE_BYTES
(`shared.storage.folder`) to the catalog. So the more important operations work for longer.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from shared.errors import StorageFull

if TYPE_CHECKING:
    from shared.config.settings import Settings

log = logging.getLogger(__name__)

RESERVE_BYTES = 16 * 1024 * 1024  # room for SQLite's write-ahead log of some thousand changes
RELEASE_BELOW_BYTES = 4 * 1024 * 1024
BLOCK_BYTES = 1024 * 1024

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


class DiskReserve:
    """The reserve file in the catalog's folder; maintained by the server or the steward."""

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        """The reserve is only written where `min_free_bytes` remain free in addition to it."""
        self._folder = folder
        self._file = folder / "reserve.bin"
        self._needed_bytes = max(min_free_bytes, RESERVE_BYTES) + RESERVE_BYTES

    def release(self) -> None:
        """Delete the reserve when the disk is nearly full."""
        if not self._file.exists():
            return
        free = shutil.disk_usage(self._folder).free
        if free < RELEASE_BELOW_BYTES:
            self._file.unlink(missing_ok=True)
            log.warning(
                "the disk of %s is full (%d bytes free): the catalog's reserve of %d bytes was "
                "released. Empty the trash of photos, delete maps, or free disk space",
                self._folder,
                free,
                RESERVE_BYTES,
            )

    def maintain(self) -> None:
        """Delete the reserve when the disk is nearly full; write it when there is enough space."""
        self.release()
        if not self._file.exists() and shutil.disk_usage(self._folder).free >= self._needed_bytes:
            self._write()

    def _write(self) -> None:
        partial = self._file.with_suffix(".partial")
        try:
            descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, RESERVE_BYTES)
                else:
                    for _ in range(RESERVE_BYTES // BLOCK_BYTES):
                        file.write(bytes(BLOCK_BYTES))
            partial.replace(self._file)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink()
            if error.errno not in DISK_FULL:
                raise


QUERY_SHARE = 0.1  # query photos are deleted soon
DISK_RETRY_SECONDS = 60


class DiskSpace:
    """The disks of PLACEWISE_HOME and UPLOAD_DIR, where this process writes to them."""

    def __init__(self, settings: Settings) -> None:
        self._min_free_bytes = settings.min_free_bytes
        self._folders = [settings.upload_dir] if settings.upload_dir else []
        if settings.s3_endpoint is None or settings.database_url is None:
            self._folders.append(settings.placewise_home)

    @property
    def is_used(self) -> bool:
        """Whether this process writes to a local disk."""
        return bool(self._folders)

    def free_bytes(self) -> int | None:
        """Return the smallest free space among the disks, in bytes.

        None if this process writes to none of them.
        """
        return min(
            (shutil.disk_usage(_existing_parent(f)).free for f in self._folders), default=None
        )

    def check(self, share: float = 1.0) -> None:
        """Raise StorageFull (`disk_full`) when less than this share of MIN_FREE_BYTES is free."""
        free, required = self.free_bytes(), int(share * self._min_free_bytes)
        if free is not None and free < required:
            raise StorageFull(
                "disk_full",
                f"The server's disk has {free // 1_000_000} MB free, and this request needs "
                f"{required // 1_000_000} MB (MIN_FREE_BYTES={self._min_free_bytes}). Free disk "
                "space, empty the trash of photos, or delete maps.",
                retry_after_seconds=DISK_RETRY_SECONDS,
                free_bytes=free,
            )


def _existing_parent(folder: Path) -> Path:
    """The folder, or its closest parent that exists."""
    while not folder.exists():
        folder = folder.parent
    return folder
