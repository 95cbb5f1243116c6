"""Objects as files below one folder, written whole: temporary file, fsync, rename.

One kind of object may lie elsewhere: the files of `originals/...` in a folder of their own, which
may be on another disk.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from shared.disk_reserve import DISK_FULL
from shared.errors import NotFound, StorageFull, Unavailable
from shared.ids import new_id
from shared.objects.keys import check_key, is_key
from shared.objects.port import ObjectInfo

# No file there, or a folder on the way or at the end: to a store of keys it is all the same.
MISSING = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
PARTIAL = ".partial"  # the folder of files being written: same file system, so rename is atomic
MARK = ".placewise"  # the file that says whose folder it is (`shared.objects.upload_dir`)
RESERVED = (PARTIAL, MARK)
FULL_RETRY_SECONDS = 60
KEPT_FREE_BYTES = 16 * 1024 * 1024  # the last of the disk is the catalog's: it deletes with that


class FolderStore:
    """An object store in a local folder. What killed writers left half written goes at start."""

    def __init__(
        self, root: Path, elsewhere: Mapping[str, Path] | None = None, *, alone: bool = True
    ) -> None:
        """`elsewhere` says in which other folder the keys lie that begin with a name and a slash:
        `{"originals": Path("/photos")}` keeps `originals/a` as `/photos/a`.

        `alone` says that no other process writes there now, so that what is half written is left
        over from one that was killed.
        """
        self.root = root
        self._elsewhere = dict(elsewhere or {})
        for folder in self._folders():
            (folder / PARTIAL).mkdir(parents=True, exist_ok=True)
            for left_over in (folder / PARTIAL).iterdir() if alone else ():
                left_over.unlink()

    def path(self, key: str) -> Path:
        """The file of a key. Keys are names joined by single slashes, none of them `.` or `..`."""
        folder, parts = self._place(key)
        return folder.joinpath(*parts)

    def writer(self, key: str) -> FolderWriter:
        folder, parts = self._place(key)
        return FolderWriter(folder.joinpath(*parts), folder / PARTIAL / str(new_id()))

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

    def read_range(self, key: str, begin: int, size_bytes: int) -> bytes:
        with self.open(key) as file:
            file.seek(begin)
            return file.read(size_bytes)

    def file(self, key: str) -> Path | None:
        return self.path(key)

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
        yield from self._list_folder(self.root, "", prefix)
        for name, folder in self._elsewhere.items():
            yield from self._list_folder(folder, f"{name}/", prefix)

    def check(self) -> None:
        for folder in self._folders():
            probe = folder / PARTIAL / str(new_id())
            try:
                probe.write_bytes(b"ok")
                probe.unlink()
            except OSError as error:
                if error.errno in DISK_FULL:
                    raise _full() from error
                raise Unavailable(
                    "object_store_unavailable",
                    f"Can't write below {folder.name}: {error.strerror}. "
                    "Check the disk's free space and the folder's permissions.",
                ) from error

    def _folders(self) -> Iterator[Path]:
        yield self.root
        yield from self._elsewhere.values()

    def _place(self, key: str) -> tuple[Path, Sequence[str]]:
        """The folder that a key lies in, and the names that lead to it from there."""
        folder, parts = self.root, check_key(key).split("/")
        if parts[0] in self._elsewhere and len(parts) > 1:
            folder, parts = self._elsewhere[parts[0]], parts[1:]
        if parts[0] in RESERVED:
            raise ValueError(f"the name {parts[0]} is the store's own: {key!r}")
        return folder, parts

    def _list_folder(self, folder: Path, begin: str, prefix: str) -> Iterator[ObjectInfo]:
        """The objects in one of the folders, whose keys begin with `begin`."""
        if not (prefix.startswith(begin) or begin.startswith(prefix)):
            return
        below = prefix.removeprefix(begin) if prefix.startswith(begin) else ""
        start = folder.joinpath(*PurePosixPath(below).parts[: below.count("/")])
        for directory, _, names in os.walk(start):
            for name in names:
                path = Path(directory, name)
                inside = path.relative_to(folder)
                key = begin + inside.as_posix()
                if inside.parts[0] in RESERVED or not key.startswith(prefix) or not is_key(key):
                    continue
                if self.path(key) != path:
                    continue  # in the root's own folder of a name that lies elsewhere
                with contextlib.suppress(FileNotFoundError):  # deleted since it was listed
                    yield _info(key, path.stat())


@contextlib.contextmanager
def _room() -> Iterator[None]:
    """StorageFull (`disk_full`) for a disk, or a quota, that takes no more."""
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise _full() from error


def _full() -> StorageFull:
    return StorageFull(
        "disk_full",
        "The disk of the object store is full: make room on it, or delete photos or maps.",
        retry_after_seconds=FULL_RETRY_SECONDS,
    )


class FolderWriter:
    """Writes beside the target and renames on `commit`."""

    @_room()
    def __init__(self, target: Path, partial: Path) -> None:
        self._target = target
        self._partial = partial
        if shutil.disk_usage(partial.parent).free < KEPT_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        # Unbuffered: what a full disk did not take is not tried again by closing the file.
        self._file = partial.open("wb", buffering=0)

    @_room()
    def write(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]

    @_room()
    def commit(self) -> None:
        os.fsync(self._file.fileno())
        self._file.close()
        # The rename has to survive a power cut, too, and so has every folder made for it.
        changed = [self._target.parent]
        while not changed[-1].exists():
            changed.append(changed[-1].parent)
        try:
            self._target.parent.mkdir(parents=True, exist_ok=True)
            self._partial.replace(self._target)
        except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:
            raise ValueError(
                f"{self._target.name!r}: one object's key continues another object's key"
            ) from error
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
