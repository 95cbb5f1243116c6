"""Objects as files below one folder, written whole: temporary file, fsync, rename."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from shared.errors import NotFound, Unavailable
from shared.ids import new_id
from shared.objects.port import ObjectInfo

# No file there, or a folder on the way or at the end: to a store of keys it is all the same.
MISSING = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
PARTIAL = ".partial"  # the folder of files being written: same file system, so rename is atomic


class FolderStore:
    """An object store in a local folder. What killed writers left half written goes at start."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._partial = root / PARTIAL
        self._partial.mkdir(parents=True, exist_ok=True)
        for left_over in self._partial.iterdir():
            left_over.unlink()

    def path(self, key: str) -> Path:
        """The file of a key. Keys are names joined by single slashes, none of them `.` or `..`."""
        parts = key.split("/")
        if any(part in ("", ".", "..") for part in parts):
            raise ValueError(f"not an object key: {key!r}")
        if parts[0] == PARTIAL:
            raise ValueError(f"the name {PARTIAL} is the store's own: {key!r}")
        return self.root.joinpath(*parts)

    def writer(self, key: str) -> FolderWriter:
        return FolderWriter(self.path(key), self._partial / str(new_id()))

    def put(self, key: str, data: bytes) -> None:
        writer = self.writer(key)
        try:
            writer.write(data)
            writer.commit()
        finally:
            writer.abort()

    def get(self, key: str) -> bytes:
        with self.open(key) as file:
            return file.read()

    def open(self, key: str) -> BinaryIO:
        try:
            return self.path(key).open("rb")
        except MISSING:
            raise NotFound(
                "object_not_found", f"The object store has no {key!r}.", key=key
            ) from None

    def head(self, key: str) -> ObjectInfo | None:
        try:
            status = self.path(key).stat()
        except MISSING:
            return None
        return _info(key, status) if stat.S_ISREG(status.st_mode) else None

    def delete(self, key: str) -> None:
        with contextlib.suppress(*MISSING):
            self.path(key).unlink()

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        folder = self.root.joinpath(*PurePosixPath(prefix).parts[: prefix.count("/")])
        for directory, _, names in os.walk(folder):
            for name in names:
                path = Path(directory, name)
                key = path.relative_to(self.root).as_posix()
                if key.startswith(f"{PARTIAL}/") or not key.startswith(prefix):
                    continue
                with contextlib.suppress(FileNotFoundError):  # deleted since it was listed
                    yield _info(key, path.stat())

    def check(self) -> None:
        probe = self._partial / str(new_id())
        try:
            probe.write_bytes(b"ok")
            probe.unlink()
        except OSError as error:
            raise Unavailable(
                "object_store_unavailable",
                f"Can't write below {self.root.name}: {error.strerror}. "
                "Check the disk's free space and the folder's permissions.",
            ) from error


class FolderWriter:
    """Writes beside the target and renames on `commit`."""

    def __init__(self, target: Path, partial: Path) -> None:
        self._target = target
        self._partial = partial
        self._file = partial.open("wb")

    def write(self, data: bytes) -> None:
        self._file.write(data)

    def commit(self) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        # The rename has to survive a power cut, too, and so has every folder made for it.
        changed = [self._target.parent]
        while not changed[-1].exists():
            changed.append(changed[-1].parent)
        self._target.parent.mkdir(parents=True, exist_ok=True)
        self._partial.replace(self._target)
        for folder in changed:
            _sync_folder(folder)

    def abort(self) -> None:
        self._file.close()
        self._partial.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _info(key: str, status: os.stat_result) -> ObjectInfo:
    return ObjectInfo(key, status.st_size, datetime.fromtimestamp(status.st_mtime, UTC))
