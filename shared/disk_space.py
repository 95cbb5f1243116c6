"""Free space of the disks that this process writes to itself, and what it refuses for want of it.

Three floors, so that what matters more goes on for longer: uploads, batches and whatever else makes
jobs need MIN_FREE_BYTES, a query photo QUERY_SHARE of that, and the object store leaves the last
KEPT_FREE_BYTES (`shared.objects.folder`) to the catalog.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from shared.errors import StorageFull
from shared.settings import Settings

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
