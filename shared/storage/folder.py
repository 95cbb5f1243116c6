"""Object store in a local folder: objects are files, written atomically.

A write goes to a temporary file, which is fsynced and renamed. The objects of a top-level name,
such as `originals/...`, may be stored in a folder of their own, also on another disk.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from shared.config.disk_space import DISK_FULL
from shared.config.private_files import create_private_file, make_private_folder, write_private
from shared.errors import StorageFull, Unavailable
from shared.ids import new_id
from shared.storage.keys import (
    OWNER_MARK,
    TRASH,
    check_key,
    check_note_name,
    is_valid_key,
    object_not_found_error,
)
from shared.storage.protocol import ObjectInfo, writing

log = logging.getLogger(__name__)

# A missing file, a file among the parents, or a folder: for a store of keys, all are missing keys.
NOT_FOUND_ERRORS = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
# The folder of files being written, on the same file system, so that a rename is atomic.
PARTIAL_FOLDER = ".partial"
# The trash of such a separate folder, on the same disk, so that moving there is a rename.
SEPARATE_TRASH = f"{OWNER_MARK}-trash"
FULL_RETRY_SECONDS = 60
RESERVED_FREE_BYTES = 16 * 1024 * 1024  # left to the catalog, which needs space to delete rows


class FolderStore:
    """An object store in a local folder; partial files of killed writers are deleted at start."""

    def __init__(
        self,
        root: Path,
        separate_folders: Mapping[str, Path] | None = None,
        *,
        exclusive: bool = True,
    ) -> None:
        """
        Args:
            root: folder of all objects that have no separate folder.
            separate_folders: folders of top-level names: `{"originals": Path("/photos")}` stores
                `originals/a` as `/photos/a`.
            exclusive: no other process writes to the folder now, so that partial files are left
                over from a killed process and can be deleted.
        """
        self.root = root
        self._separate_folders = dict(separate_folders or {})
        for folder in self._folders():
            make_private_folder(folder / PARTIAL_FOLDER)
            for partial in (folder / PARTIAL_FOLDER).iterdir() if exclusive else ():
                partial.unlink()

    def path(self, key: str) -> Path:
        """Return the file of a key; ValueError for an invalid key."""
        folder, parts = self._locate(key)
        return folder.joinpath(*parts)

    def writer(self, key: str) -> FolderWriter:
        folder, parts = self._locate(key)
        return FolderWriter(
            folder.joinpath(*parts),
            folder / PARTIAL_FOLDER / str(new_id()),
        )

    def put(self, key: str, data: bytes) -> None:
        with writing(self, key) as writer:
            writer.write(data)

    def get(self, key: str) -> bytes:
        with self.open(key) as file:
            return file.read()

    def open(self, key: str) -> BinaryIO:
        try:
            return self.path(key).open("rb")
        except NOT_FOUND_ERRORS:
            raise object_not_found_error(key) from None

    def read_range(self, key: str, begin: int, size_bytes: int) -> bytes:
        with self.open(key) as file:
            file.seek(begin)
            return file.read(size_bytes)

    def file(self, key: str) -> Path | None:
        return self.path(key)

    def head(self, key: str) -> ObjectInfo | None:
        try:
            status = self.path(key).stat()
        except NOT_FOUND_ERRORS:
            return None
        return _info(key, status) if stat.S_ISREG(status.st_mode) else None

    def delete(self, key: str) -> None:
        path = self.path(key)
        with contextlib.suppress(*NOT_FOUND_ERRORS):
            path.unlink()
        if key.startswith(TRASH):  # otherwise an empty folder of each day would remain
            _remove_empty_folders(path.parent, self._trash_of(self._locate(key)[0]))

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        yield from self._list_folder(self.root, "", prefix)
        for name, folder in self._separate_folders.items():
            yield from self._list_folder(folder, f"{name}/", prefix)
            if TRASH.startswith(prefix) or prefix.startswith(TRASH):
                with contextlib.suppress(*NOT_FOUND_ERRORS):
                    for day in sorted((folder / SEPARATE_TRASH).iterdir()):
                        yield from self._list_folder(day, f"{TRASH}{day.name}/{name}/", prefix)

    def move(self, source: str, target: str) -> None:
        old, new = self.path(source), self.path(target)
        if self.head(source) is None:
            raise object_not_found_error(source)
        try:
            os.utime(old)
            changed_folders = _make_parents(new)
            try:
                old.replace(new)
            except OSError as error:
                if error.errno != errno.EXDEV:
                    raise
                self._copy(old, target)  # one of the folders is a mount point
                old.unlink()
        except NOT_FOUND_ERRORS:
            raise object_not_found_error(source) from None
        for folder in (*changed_folders, old.parent):
            _sync_folder(folder)

    def free_trash(self, min_free_bytes: int) -> int:
        return sum(self._free_trash(folder, min_free_bytes) for folder in self._folders())

    def read_note(self, name: str) -> bytes | None:
        try:
            return self._note(name).read_bytes()
        except FileNotFoundError:
            return None

    def write_note(self, name: str, data: bytes, *, replace: bool = True) -> None:
        note, partial = self._note(name), self.root / PARTIAL_FOLDER / str(new_id())
        write_private(partial, data.decode())
        if replace:
            partial.replace(note)
        else:
            with contextlib.suppress(FileExistsError):
                note.hardlink_to(partial)  # of two concurrent writers one succeeds
            partial.unlink()
        _sync_folder(self.root)

    def delete_note(self, name: str) -> None:
        self._note(name).unlink(missing_ok=True)

    def check(self) -> None:
        for folder in self._folders():
            probe = folder / PARTIAL_FOLDER / str(new_id())
            try:
                with create_private_file(probe) as file:
                    file.write(b"ok")
                probe.unlink()
            except OSError as error:
                if error.errno in DISK_FULL:
                    raise _disk_full_error() from error
                raise Unavailable(
                    "object_store_unavailable",
                    f"Can't write to the folder {folder.name}: {error.strerror}. "
                    "Check the disk's free space and the folder's permissions.",
                ) from error

    def _folders(self) -> Iterator[Path]:
        yield self.root
        yield from self._separate_folders.values()

    def _locate(self, key: str) -> tuple[Path, Sequence[str]]:
        """Return the folder of a key, and the path of its file relative to it."""
        folder, parts = self.root, check_key(key).split("/")
        if f"{parts[0]}/" == TRASH and len(parts) > 3 and parts[2] in self._separate_folders:
            return self._separate_folders[parts[2]], [SEPARATE_TRASH, parts[1], *parts[3:]]
        if parts[0] in self._separate_folders and len(parts) > 1:
            folder, parts = self._separate_folders[parts[0]], parts[1:]
        if _is_reserved(parts[0]):
            raise ValueError(f"the name {parts[0]} is reserved by the store: {key!r}")
        return folder, parts

    def _note(self, name: str) -> Path:
        return self.root / check_note_name(name)

    def _trash_of(self, folder: Path) -> Path:
        return folder / (TRASH.rstrip("/") if folder == self.root else SEPARATE_TRASH)

    def _free_trash(self, folder: Path, min_free_bytes: int) -> int:
        """Delete the trash of this folder, oldest day first, until its disk has this much free.

        Returns:
            The number of deleted files.
        """
        trash, deleted = self._trash_of(folder), 0
        with contextlib.suppress(*NOT_FOUND_ERRORS):
            for day in sorted(trash.iterdir()):
                if shutil.disk_usage(folder).free >= min_free_bytes:
                    break
                for directory, _, names in os.walk(day):
                    for name in names:
                        with contextlib.suppress(*NOT_FOUND_ERRORS):
                            Path(directory, name).unlink()
                            deleted += 1
                for directory, _, _ in os.walk(day, topdown=False):
                    _remove_empty_folders(Path(directory), trash)
        if deleted:
            log.warning("low disk space: %d objects in the trash were deleted", deleted)
        return deleted

    def _copy(self, path: Path, key: str) -> None:
        with writing(self, key) as writer, path.open("rb") as file:
            shutil.copyfileobj(file, writer)

    def _list_folder(self, folder: Path, base_key: str, prefix: str) -> Iterator[ObjectInfo]:
        """Iterate over the objects of one folder, whose keys begin with `base_key`."""
        if not (prefix.startswith(base_key) or base_key.startswith(prefix)):
            return
        below = prefix.removeprefix(base_key) if prefix.startswith(base_key) else ""
        start = folder.joinpath(*PurePosixPath(below).parts[: below.count("/")])
        for directory, folders, names in os.walk(start):
            if Path(directory) == folder:
                folders[:] = [name for name in folders if not _is_reserved(name)]
            for name in names:
                path = Path(directory, name)
                relative_path = path.relative_to(folder)
                key = base_key + relative_path.as_posix()
                if (
                    _is_reserved(relative_path.parts[0])
                    or not key.startswith(prefix)
                    or not is_valid_key(key)
                ):
                    continue
                if self.path(key) != path:
                    continue  # under the root, but its name has a separate folder
                with contextlib.suppress(FileNotFoundError):  # deleted since it was listed
                    yield _info(key, path.stat())


@contextlib.contextmanager
def _raise_storage_full() -> Iterator[None]:
    """Convert the errors of a full disk or quota to StorageFull (`disk_full`)."""
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise _disk_full_error() from error


def _disk_full_error() -> StorageFull:
    return StorageFull(
        "disk_full",
        "The disk of the object store is full. Free disk space, empty the trash, or delete maps.",
        retry_after_seconds=FULL_RETRY_SECONDS,
    )


class FolderWriter:
    """Writes a partial file and renames it on `commit`."""

    @_raise_storage_full()
    def __init__(self, target: Path, partial: Path) -> None:
        self._target = target
        self._partial = partial
        if shutil.disk_usage(partial.parent).free < RESERVED_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        # Unbuffered: closing the file must not retry a write that a full disk rejected.
        self._file = create_private_file(partial, buffering=0)

    @_raise_storage_full()
    def write(self, data: bytes) -> None:
        remaining = memoryview(data)
        while remaining:
            remaining = remaining[self._file.write(remaining) :]

    @_raise_storage_full()
    def commit(self) -> None:
        os.fsync(self._file.fileno())
        self._file.close()
        try:
            changed_folders = _make_parents(self._target)
            self._partial.replace(self._target)
        except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:
            raise ValueError(
                f"{self._target.name!r}: an object's key must not be the parent of another key"
            ) from error
        for folder in changed_folders:
            _sync_folder(folder)

    def abort(self) -> None:
        self._file.close()
        self._partial.unlink(missing_ok=True)


def _is_reserved(name: str) -> bool:
    """Return whether the store uses a top-level name itself, so that no object may have it."""
    return name == PARTIAL_FOLDER or name.startswith(OWNER_MARK)


def _make_parents(file: Path) -> Sequence[Path]:
    """Create the parents of a file; return the folders to fsync after it was renamed.

    The rename must survive a power loss, and so must every folder created for it.
    """
    changed = [file.parent]
    while not changed[-1].exists():
        changed.append(changed[-1].parent)
    make_private_folder(file.parent)
    return changed


def _remove_empty_folders(folder: Path, top: Path) -> None:
    """Delete the folder and its parents, up to `top`, while they are empty."""
    with contextlib.suppress(OSError):
        while folder.is_relative_to(top):
            folder.rmdir()
            folder = folder.parent


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _info(key: str, status: os.stat_result) -> ObjectInfo:
    return ObjectInfo(key, status.st_size, datetime.fromtimestamp(status.st_mtime, UTC))
