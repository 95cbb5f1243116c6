"""Files and folders that only the current user can read, whatever the umask is."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path
from typing import BinaryIO

FOLDER_MODE = 0o700
FILE_MODE = 0o600
_GROUP_AND_OTHERS = 0o077  # permission bits of the group and of everyone else


def make_private_folder(folder: Path) -> None:
    """Create the folder and its missing parents with mode 0700; existing ones are unchanged."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    if not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))
    for parent in reversed(missing):
        with contextlib.suppress(FileExistsError):  # another process created it
            parent.mkdir(FOLDER_MODE)


def create_private_file(file: Path, buffering: int = -1) -> BinaryIO:
    """Open the file for writing and truncate it; a new file has mode 0600."""
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, FILE_MODE)
    return os.fdopen(descriptor, "wb", buffering)


def write_private(file: Path, text: str) -> None:
    """Write the file atomically and durably, with mode 0600 from its first byte on."""
    partial = file.with_name(f".{file.name}.partial")
    partial.unlink(missing_ok=True)  # of a killed process, with an unknown mode
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, FILE_MODE)
    with os.fdopen(descriptor, "w") as opened:
        opened.write(text)
        opened.flush()
        os.fsync(opened.fileno())
    partial.replace(file)


def is_open_to_others(path: Path) -> bool:
    """Return whether the group or other users have any permission on the path."""
    return bool(path.stat().st_mode & _GROUP_AND_OTHERS)
