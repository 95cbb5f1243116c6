"""Objects as files of this machine, mapped into memory: the operating system reads what is used.

Where objects are files already, they are mapped where they lie. Elsewhere they are fetched into a
cache folder, which any number of search workers of this machine may share.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import mmap
import os
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from shared.chunks import chunk_corrupt_error
from shared.ids import new_id
from shared.objects import ObjectStore
from shared.private_files import create_private_file, make_private_folder

log = logging.getLogger(__name__)

COPY_BYTES = 1 << 20
STALE_PARTIAL_SECONDS = 3600.0  # a file that is still being written then: its writer was killed

# From Python 3.13 on a mapping need not hold a file descriptor: many chunks would use them up.
MMAP_OPTIONS = {"trackfd": False} if sys.version_info >= (3, 13) else {}


@dataclass(frozen=True, slots=True, eq=False)
class MappedFile:
    """A file's bytes; the file may be deleted or replaced while they are used."""

    memory: mmap.mmap
    path: Path
    state: os.stat_result
    """Of the file when it was mapped."""

    def was_changed(self) -> bool:
        """Whether the mapped file itself was written to or truncated: what is read from the
        mapping then is another row, or ends the process (SIGBUS). A file that was deleted or
        replaced leaves the mapping as it was."""
        try:
            now = self.path.stat()
        except OSError:
            return False
        same = (now.st_dev, now.st_ino) == (self.state.st_dev, self.state.st_ino)
        return same and (now.st_size, now.st_mtime_ns) != (
            self.state.st_size,
            self.state.st_mtime_ns,
        )

    @property
    def size_bytes(self) -> int:
        return len(self.memory)

    def prefetch(self, begin: int, size_bytes: int) -> None:
        """Say that these bytes are read next: many at once cost little more than one."""
        first = begin - begin % mmap.PAGESIZE
        self.memory.madvise(mmap.MADV_WILLNEED, first, begin + size_bytes - first)


class MappedFileCache:
    """The store's objects as mapped files."""

    def __init__(self, store: ObjectStore, folder: Path) -> None:
        """`folder` is made when something is fetched."""
        self._store = store
        self._folder = folder

    def map_object(self, key: str, sha256: str) -> MappedFile:
        """The object, whose hash was checked: when it was fetched, or now where it is a file.

        Unavailable (`chunk_corrupt`) when it is another; NotFound and Unavailable of the store.
        """
        file = self._store.file(key)
        if file is None:
            return self._cached(key, sha256)
        with self._store.open(key) as opened:
            mapped = _map_file(opened.fileno(), file)
        if hashlib.sha256(mapped.memory).hexdigest() != sha256:
            raise chunk_corrupt_error(key)
        return mapped

    def _cached(self, key: str, sha256: str) -> MappedFile:
        """The object from the cache; one that was damaged there is fetched again."""
        name = f"{sha256}.npy"
        fetched = False

        def fetch(target: Path) -> None:
            nonlocal fetched
            fetched = True
            self._download(key, sha256, target)

        with contextlib.suppress(ValueError):  # an empty file can't be mapped
            mapped = self.map_or_create(name, fetch)
            if fetched or hashlib.sha256(mapped.memory).hexdigest() == sha256:
                return mapped
        log.warning("the cached copy of %s is damaged, and is fetched again", key)
        self.evict(name)
        return self.map_or_create(name, fetch)

    def map_or_create(self, name: str, make: Callable[[Path], None]) -> MappedFile:
        """The file of this name in the folder; where there is none, `make` writes one.

        It is there whole or not at all, also after a power cut.
        """
        path = self._folder / name
        with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
            return _map_file(file.fileno(), path)
        make_private_folder(self._folder)
        partial = self._folder / f"{new_id()}.partial"
        try:
            make(partial)
            with partial.open("rb") as file:
                mapped = _map_file(file.fileno(), path)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        return mapped

    def evict(self, name: str) -> None:
        (self._folder / name).unlink(missing_ok=True)

    def evict_except(self, names: Collection[str]) -> None:
        """Remove what is in the folder under other names; what is mapped stays readable."""
        if not self._folder.is_dir():
            return
        long_ago = time.time() - STALE_PARTIAL_SECONDS
        for path in self._folder.iterdir():
            with contextlib.suppress(FileNotFoundError):
                if path.suffix == ".partial":
                    unwanted = path.stat().st_mtime < long_ago
                else:
                    unwanted = path.name not in names
                if unwanted:
                    path.unlink()

    def _download(self, key: str, sha256: str, target: Path) -> None:
        digest = hashlib.sha256()
        with self._store.open(key) as source, create_private_file(target) as file:
            while piece := source.read(COPY_BYTES):
                digest.update(piece)
                file.write(piece)
            if digest.hexdigest() != sha256:
                raise chunk_corrupt_error(key)
            file.flush()
            os.fsync(file.fileno())


def _map_file(descriptor: int, path: Path) -> MappedFile:
    memory = mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ, **MMAP_OPTIONS)
    return MappedFile(memory, path, os.fstat(descriptor))
