"""Free disk space: the check before bytes are accepted.

Uploads, batches and other requests that create jobs need MIN_FREE_BYTES, a query photo needs
QUERY_SHARE of that, and the object store leaves the last RESERVED_FREE_BYTES
(`shared.storage.folder`) to the catalog: SQLite can't even delete rows on a full disk. So the more
important operations work for longer.
"""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from shared.errors import StorageFull

if TYPE_CHECKING:
    from shared.config.settings import Settings

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


QUERY_SHARE = 0.1  # query photos are deleted soon
DISK_RETRY_SECONDS = 60


class DiskSpace:
    """The disks of PLACEWISE_HOME and UPLOAD_DIR, where this process writes to them."""

    def __init__(self, settings: Settings) -> None:
        self._min_free_bytes = settings.min_free_bytes
        self._folders = [settings.upload_dir] if settings.upload_dir else []
        if settings.s3_endpoint is None or settings.database_url is None:
            self._folders.append(settings.placewise_home)

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
