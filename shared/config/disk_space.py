"""Disk space that is set aside for the catalog: without any, SQLite can't even delete rows.

A file of RESERVE_BYTES beside the catalog is deleted when the disk is full, so that the server
starts and photos can be deleted, and is written again once there is room.

Free space of the disks that this process writes to itself, and what it refuses for want of it.

Three floors, so that what matters more goes on for longer: uploads, batches and whatever else makes
jobs need MIN_FREE_BYTES, a query photo QUERY_SHARE of that, and the object store leaves the last
KEPT_FREE_BYTES (`shared.storage.folder`) to the catalog.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
from pathlib import Path

from shared.config.settings import Settings
from shared.errors import StorageFull

log = logging.getLogger(__name__)

RESERVE_BYTES = 16 * 1024 * 1024  # the log of some thousand changes, which SQLite writes first
RELEASE_BELOW_BYTES = 4 * 1024 * 1024
PIECE_BYTES = 1024 * 1024

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


class DiskReserve:
    """The reserve in the catalog's folder. The folder's one process, or its steward, keeps it."""

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        """`min_free_bytes` stay free beside the reserve when it is written again."""
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
                "the disk of %s is full (%d bytes free): %d bytes that were set aside for the "
                "catalog are freed. Delete photos or maps, or make room",
                self._folder,
                free,
                RESERVE_BYTES,
            )

    def keep(self) -> None:
        """Delete the reserve when the disk is nearly full; write it when there is room."""
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
                    for _ in range(RESERVE_BYTES // PIECE_BYTES):
                        file.write(bytes(PIECE_BYTES))
            partial.replace(self._file)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink()
            if error.errno not in DISK_FULL:
                raise


QUERY_SHARE = 0.1  # a query photo is kept for minutes only
DISK_RETRY_SECONDS = 60


class DiskSpace:
    """The disks of PLACEWISE_HOME and UPLOAD_DIR, as far as anything is written there."""

    def __init__(self, settings: Settings) -> None:
        self._min_free_bytes = settings.min_free_bytes
        self._folders = [settings.upload_dir] if settings.upload_dir else []
        if settings.s3_endpoint is None or settings.database_url is None:
            self._folders.append(settings.placewise_home)

    def free_bytes(self) -> int | None:
        """Of the disks, the least; None where nothing is written to any."""
        return min((shutil.disk_usage(_existing(f)).free for f in self._folders), default=None)

    def check(self, share: float = 1.0) -> None:
        """Raise StorageFull (`disk_full`) when less than this share of MIN_FREE_BYTES is free."""
        free, least = self.free_bytes(), int(share * self._min_free_bytes)
        if free is not None and free < least:
            raise StorageFull(
                "disk_full",
                f"The server's disk has {free // 1_000_000} MB free, and this needs "
                f"{least // 1_000_000} MB (MIN_FREE_BYTES={self._min_free_bytes}). Make room, or "
                "delete photos or maps.",
                retry_after_seconds=DISK_RETRY_SECONDS,
                free_bytes=free,
            )


def _existing(folder: Path) -> Path:
    """The folder, or the one above it that it will be made in."""
    while not folder.exists():
        folder = folder.parent
    return folder
