"""Objects as files below one folder, written whole: temporary file, fsync, rename.

One kind of object may lie elsewhere: the files of `originals/...` in a folder of their own, which
may be on another disk.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from shared.config.disk_space import DISK_FULL
from shared.config.private_files import create_private_file, make_private_folder, write_private
from shared.errors import NotFound, StorageFull, Unavailable
from shared.ids import new_id
from shared.storage.keys import TRASH, check_key, is_valid_key
from shared.storage.protocol import ObjectInfo

log = logging.getLogger(__name__)

# No file there, or a folder on the way or at the end: to a store of keys it is all the same.
NOT_FOUND_ERRORS = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
PARTIAL_SUFFIX = (
    ".partial"  # the folder of files being written: same file system, so rename is atomic
)
OWNER_MARK = ".placewise"  # the file that says whose folder it is (`shared.storage.open_store`)
# Another folder's part of the trash, on its own disk: so a move into the trash is a rename.
TRASH_ELSEWHERE = f"{OWNER_MARK}-trash"
FULL_RETRY_SECONDS = 60
PIECE_BYTES = 1024 * 1024
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
            make_private_folder(folder / PARTIAL_SUFFIX)
            for left_over in (folder / PARTIAL_SUFFIX).iterdir() if alone else ():
                left_over.unlink()

    def path(self, key: str) -> Path:
        """The file of a key. Keys are names joined by single slashes, none of them `.` or `..`."""
        folder, parts = self._locate(key)
        return folder.joinpath(*parts)

    def writer(self, key: str) -> FolderWriter:
        folder, parts = self._locate(key)
        return FolderWriter(
            folder.joinpath(*parts),
            folder / PARTIAL_SUFFIX / str(new_id()),
            lambda: self._empty_trash(folder) > 0,
        )

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
        except NOT_FOUND_ERRORS:
            raise _not_found(key) from None

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
        if key.startswith(TRASH):  # or a folder would be left for each day
            _remove_empty_folders(path.parent, self._trash_of(self._locate(key)[0]))

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        yield from self._list_folder(self.root, "", prefix)
        for name, folder in self._elsewhere.items():
            yield from self._list_folder(folder, f"{name}/", prefix)
            if TRASH.startswith(prefix) or prefix.startswith(TRASH):
                with contextlib.suppress(*NOT_FOUND_ERRORS):
                    for day in sorted((folder / TRASH_ELSEWHERE).iterdir()):
                        yield from self._list_folder(day, f"{TRASH}{day.name}/{name}/", prefix)

    def move(self, source: str, target: str) -> None:
        old, new = self.path(source), self.path(target)
        if self.head(source) is None:
            raise _not_found(source)
        try:
            os.utime(old)
            made = _make_parents(new)
            try:
                old.replace(new)
            except OSError as error:
                if error.errno != errno.EXDEV:
                    raise
                self._copy(old, target)  # one of the folders is a mount of its own
                old.unlink()
        except NOT_FOUND_ERRORS:
            raise _not_found(source) from None
        for folder in (*made, old.parent):
            _sync_folder(folder)

    def free_trash(self, least_free_bytes: int) -> int:
        return sum(self._empty_trash(folder, least_free_bytes) for folder in self._folders())

    def read_note(self, name: str) -> bytes | None:
        try:
            return self._note(name).read_bytes()
        except FileNotFoundError:
            return None

    def write_note(self, name: str, data: bytes, *, replace: bool = True) -> None:
        note, partial = self._note(name), self.root / PARTIAL_SUFFIX / str(new_id())
        write_private(partial, data.decode())
        if replace:
            partial.replace(note)
        else:
            with contextlib.suppress(FileExistsError):
                note.hardlink_to(partial)  # of two at the same moment one succeeds
            partial.unlink()
        _sync_folder(self.root)

    def delete_note(self, name: str) -> None:
        self._note(name).unlink(missing_ok=True)

    def check(self) -> None:
        for folder in self._folders():
            probe = folder / PARTIAL_SUFFIX / str(new_id())
            try:
                with create_private_file(probe) as file:
                    file.write(b"ok")
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

    def _locate(self, key: str) -> tuple[Path, Sequence[str]]:
        """The folder that a key lies in, and the names that lead to it from there."""
        folder, parts = self.root, check_key(key).split("/")
        if f"{parts[0]}/" == TRASH and len(parts) > 3 and parts[2] in self._elsewhere:
            return self._elsewhere[parts[2]], [TRASH_ELSEWHERE, parts[1], *parts[3:]]
        if parts[0] in self._elsewhere and len(parts) > 1:
            folder, parts = self._elsewhere[parts[0]], parts[1:]
        if _is_reserved(parts[0]):
            raise ValueError(f"the name {parts[0]} is the store's own: {key!r}")
        return folder, parts

    def _note(self, name: str) -> Path:
        if not name.startswith(OWNER_MARK) or not is_valid_key(name) or "/" in name:
            raise ValueError(f"not the name of a note: {name!r}")
        return self.root / name

    def _trash_of(self, folder: Path) -> Path:
        return folder / (TRASH.rstrip("/") if folder == self.root else TRASH_ELSEWHERE)

    def _empty_trash(self, folder: Path, least_free_bytes: int | None = None) -> int:
        """Delete what lies in the trash of this folder, oldest day first, all or until its disk has
        this much free; how many files."""
        trash, deleted = self._trash_of(folder), 0
        with contextlib.suppress(*NOT_FOUND_ERRORS):
            for day in sorted(trash.iterdir()):
                free = shutil.disk_usage(folder).free
                if least_free_bytes is not None and free >= least_free_bytes:
                    break
                for directory, _, names in os.walk(day):
                    for name in names:
                        with contextlib.suppress(*NOT_FOUND_ERRORS):
                            Path(directory, name).unlink()
                            deleted += 1
                for directory, _, _ in os.walk(day, topdown=False):
                    _remove_empty_folders(Path(directory), trash)
        if deleted:
            log.warning("no room on the disk: %d objects of the trash were deleted", deleted)
        return deleted

    def _copy(self, path: Path, key: str) -> None:
        writer = self.writer(key)
        try:
            with path.open("rb") as file:
                while piece := file.read(PIECE_BYTES):
                    writer.write(piece)
            writer.commit()
        finally:
            writer.abort()

    def _list_folder(self, folder: Path, begin: str, prefix: str) -> Iterator[ObjectInfo]:
        """The objects in one of the folders, whose keys begin with `begin`."""
        if not (prefix.startswith(begin) or begin.startswith(prefix)):
            return
        below = prefix.removeprefix(begin) if prefix.startswith(begin) else ""
        start = folder.joinpath(*PurePosixPath(below).parts[: below.count("/")])
        for directory, folders, names in os.walk(start):
            if Path(directory) == folder:
                folders[:] = [name for name in folders if not _is_reserved(name)]
            for name in names:
                path = Path(directory, name)
                inside = path.relative_to(folder)
                key = begin + inside.as_posix()
                if (
                    _is_reserved(inside.parts[0])
                    or not key.startswith(prefix)
                    or not is_valid_key(key)
                ):
                    continue
                if self.path(key) != path:
                    continue  # in the root's own folder of a name that lies elsewhere
                with contextlib.suppress(FileNotFoundError):  # deleted since it was listed
                    yield _info(key, path.stat())


@contextlib.contextmanager
def _raise_storage_full() -> Iterator[None]:
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
    """Writes beside the target and renames on `commit`. On a full disk it goes on where
    `make_room` could delete something."""

    @_raise_storage_full()
    def __init__(self, target: Path, partial: Path, make_room: Callable[[], bool]) -> None:
        self._target = target
        self._partial = partial
        self._make_room = make_room
        while shutil.disk_usage(partial.parent).free < KEPT_FREE_BYTES:
            if not make_room():
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        # Unbuffered: what a full disk did not take is not tried again by closing the file.
        self._file = create_private_file(partial, buffering=0)

    @_raise_storage_full()
    def write(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            try:
                left = left[self._file.write(left) :]
            except OSError as error:
                if error.errno not in DISK_FULL or not self._make_room():
                    raise

    @_raise_storage_full()
    def commit(self) -> None:
        os.fsync(self._file.fileno())
        self._file.close()
        try:
            made = _make_parents(self._target)
            self._partial.replace(self._target)
        except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:
            raise ValueError(
                f"{self._target.name!r}: one object's key continues another object's key"
            ) from error
        for folder in made:
            _sync_folder(folder)

    def abort(self) -> None:
        self._file.close()
        self._partial.unlink(missing_ok=True)


def _not_found(key: str) -> NotFound:
    return NotFound("object_not_found", f"The object store has no {key!r}.", key=key)


def _is_reserved(name: str) -> bool:
    """Whether a name directly in one of the folders is the store's own: no object lies there."""
    return name == PARTIAL_SUFFIX or name.startswith(OWNER_MARK)


def _make_parents(file: Path) -> Sequence[Path]:
    """Create the folders of a file that is to be renamed. Those that changed by that: the rename
    has to survive a power cut, and so has every folder made for it."""
    changed = [file.parent]
    while not changed[-1].exists():
        changed.append(changed[-1].parent)
    make_private_folder(file.parent)
    return changed


def _remove_empty_folders(folder: Path, top: Path) -> None:
    """The folder and those above it, up to `top`, as far as they are empty."""
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
