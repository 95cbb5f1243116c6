"""Chunk loader: a chunk's rows and codes as memory-mapped files, or copied into memory.

`MappedFileCache` maps objects with verified hashes: a file-based object store is mapped in place;
from other stores, objects are downloaded into a cache folder, which any number of search workers of
this machine may share. `ChunkLoader` opens the chunks of a generation, with codes that are missing
computed from the rows. `MemoryBudget` decides which parts of a `LoadedChunk` are in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import mmap
import os
import shutil
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.photo_columns import PhotoColumns
from shared.catalog.chunks import Chunk
from shared.config.private_files import create_private_file, make_private_folder
from shared.errors import NotFound
from shared.ids import new_id
from shared.storage import ObjectStore
from shared.storage.chunks import StoredRows, chunk_corrupt_error, codes_key, decode_rows
from shared.storage.copying import PARTIAL_SUFFIX, download_object, remove_stale_partials

if TYPE_CHECKING:
    from shared.codes.sign_codes import SignCodes


log = logging.getLogger(__name__)

# A mapping holds a file descriptor, and many chunks would use them up; Python 3.13 can do without.
MMAP_OPTIONS = {"trackfd": False} if sys.version_info >= (3, 13) else {}


@dataclass(frozen=True, slots=True, eq=False)
class _MappedFile:
    """A memory-mapped file, which may be deleted or replaced while it is mapped."""

    memory: mmap.mmap
    path: Path
    state: os.stat_result
    """State of the file when it was mapped."""

    def was_changed(self) -> bool:
        """Whether the mapped file itself was written to or truncated.

        Reading the mapping would then return other rows or terminate the process (SIGBUS). A file
        that was deleted or replaced leaves the mapping intact.
        """
        try:
            current = self.path.stat()
        except OSError:
            return False
        same_file = (current.st_dev, current.st_ino) == (self.state.st_dev, self.state.st_ino)
        return same_file and (current.st_size, current.st_mtime_ns) != (
            self.state.st_size,
            self.state.st_mtime_ns,
        )

    @property
    def size_bytes(self) -> int:
        return len(self.memory)

    def prefetch(self, begin: int, size_bytes: int) -> None:
        """Advise the system that these bytes are read next.

        Advising many ranges before reading them costs little more than a single read.
        """
        first = begin - begin % mmap.PAGESIZE
        self.memory.madvise(mmap.MADV_WILLNEED, first, begin + size_bytes - first)


class MappedFileCache:
    """Maps objects of the store as files."""

    def __init__(self, store: ObjectStore, folder: Path) -> None:
        """Create a cache in `folder`, which is created at the first download."""
        self._store = store
        self._folder = folder

    def map_object(self, key: str, sha256: str) -> _MappedFile:
        """Map an object whose hash is verified: at the download, or now for a file-based store.

        Raises:
            Unavailable: `chunk_corrupt` if its hash differs; also as the store raises it.
            NotFound: As the store raises it.
        """
        file = self._store.file(key)
        if file is None:
            return self._cached(key, sha256)
        with self._store.open(key) as opened:
            mapped = _map_file(opened.fileno(), file)
        if hashlib.sha256(mapped.memory).hexdigest() != sha256:
            raise chunk_corrupt_error(key)
        return mapped

    def _cached(self, key: str, sha256: str) -> _MappedFile:
        """Map the object from the cache; a damaged copy is downloaded again."""
        name = f"{sha256}.npy"
        downloaded = False

        def download(target: Path) -> None:
            nonlocal downloaded
            downloaded = True
            self._download(key, sha256, target)

        with contextlib.suppress(ValueError):  # an empty file can't be mapped
            mapped = self.map_or_create(name, download)
            if downloaded or hashlib.sha256(mapped.memory).hexdigest() == sha256:
                return mapped
        log.warning("the cached copy of %s is damaged and is downloaded again", key)
        self.evict(name)
        return self.map_or_create(name, download)

    def map_or_create(self, name: str, make: Callable[[Path], None]) -> _MappedFile:
        """Map the file of this name in the folder; `make` writes it if it does not exist.

        The file is created atomically and durably: it never exists in part, even after a power
        failure.
        """
        path = self._folder / name
        with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
            return _map_file(file.fileno(), path)
        make_private_folder(self._folder)
        partial = self._folder / f"{new_id()}{PARTIAL_SUFFIX}"
        try:
            make(partial)
            with partial.open("rb") as file:
                mapped = _map_file(file.fileno(), path)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        return mapped

    def evict(self, name: str) -> None:
        """Delete the file of this name, if it exists."""
        (self._folder / name).unlink(missing_ok=True)

    def evict_except(self, names: Collection[str]) -> None:
        """Delete the files of all other names from the folder; existing mappings stay readable."""
        if not self._folder.is_dir():
            return
        remove_stale_partials(self._folder)
        for path in self._folder.iterdir():
            if path.suffix != PARTIAL_SUFFIX and path.name not in names:
                path.unlink(missing_ok=True)

    def _download(self, key: str, sha256: str, target: Path) -> None:
        if download_object(self._store, key, target) != sha256:
            raise chunk_corrupt_error(key)


def _map_file(descriptor: int, path: Path) -> _MappedFile:
    memory = mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ, **MMAP_OPTIONS)
    return _MappedFile(memory, path, os.fstat(descriptor))


@dataclass(frozen=True, slots=True, eq=False)
class LoadedChunk:
    """A chunk's rows, (n, dimension), with the columns of their photos, and codes."""

    chunk_id: UUID
    object_key: str
    rows: StoredRows
    photos: PhotoColumns
    codes: SignCodes | None = None
    """Sign codes; None while they are not in use."""
    stored: StoredChunk | None = None
    """The mapped files; None for rows that exist in memory only."""

    def was_changed(self) -> bool:
        """Whether its mapped file was changed; see `_MappedFile.was_changed`."""
        return self.stored is not None and self.stored.file.was_changed()

    def prefetch_row(self, row: int) -> None:
        """Advise the system that a row is read next, if it is in a mapped file."""
        if self.stored is not None and self.rows is self.stored.rows:
            size_bytes = self.rows.strides[0]
            begin = self.stored.file.size_bytes - self.rows.nbytes  # the rows follow a header
            self.stored.file.prefetch(begin + row * size_bytes, size_bytes)


@dataclass(frozen=True, slots=True, eq=False)
class StoredChunk:
    """A chunk's memory-mapped files."""

    file: _MappedFile
    rows: StoredRows
    sha256: str
    codes: SignCodes | None = None


CACHED_SUFFIXES = (".npy", ".codes")  # of a chunk's files in the cache folder


class ChunkLoader:
    """Opens the chunks of one generation."""

    def __init__(self, store: ObjectStore, folder: Path) -> None:
        """`folder` is the generation's cache, for downloads and for computed codes."""
        self._store = store
        self._files = MappedFileCache(store, folder)

    def load_rows(self, chunk: Chunk) -> StoredChunk:
        """Map the rows of a chunk, with their hash verified; codes are not loaded.

        Raises:
            Unavailable, NotFound, OSError, ValueError: The chunk can't be read.
        """
        file = self._files.map_object(chunk.object_key, chunk.sha256)
        return StoredChunk(file, decode_rows(file.memory), chunk.sha256)

    def load_sign_codes(self, object_key: str, stored: StoredChunk) -> SignCodes:
        """Load the chunk's sign codes: those stored beside it, or else computed from its rows."""
        from shared.codes.serialization import decode_sign_codes, encode_sign_codes

        def write_stored(target: Path) -> None:
            _write_durably(target, self._store.get(codes_key(object_key)))

        def write_computed(target: Path) -> None:
            _write_durably(target, encode_sign_codes(stored.rows, stored.sha256))

        name = f"{stored.sha256}.codes"
        rows, dimension = stored.rows.shape
        for write in (write_stored, write_computed):
            try:
                file = self._files.map_or_create(name, write)
                return decode_sign_codes(
                    file.memory, rows=rows, dimension=dimension, chunk_sha256=stored.sha256
                )
            except NotFound:
                continue
            except ValueError as error:
                log.warning("the codes of %s are computed again: %s", object_key, error)
                self._files.evict(name)
        raise AssertionError("codes that were just computed match the rows")

    def evict_except(self, chunks: Collection[LoadedChunk]) -> None:
        """Delete the cached files of all other chunks."""
        hashes = [chunk.stored.sha256 for chunk in chunks if chunk.stored is not None]
        self._files.evict_except(
            {f"{sha256}{suffix}" for sha256 in hashes for suffix in CACHED_SUFFIXES}
        )


def list_generation_folders(folder: Path) -> list[Path]:
    """Return the cache folders of the generations."""
    return list(folder.iterdir()) if folder.is_dir() else []


def remove_stale_folders(folders: Iterable[Path], generation_ids: Collection[UUID]) -> None:
    """Delete the cache folders of all but these generations."""
    known = {str(generation_id) for generation_id in generation_ids}
    for path in folders:
        if path.name not in known:
            log.info("deleting the cached files of generation %s", path.name)
            shutil.rmtree(path, ignore_errors=True)


def hold_in_memory(chunk: LoadedChunk, parts: int) -> LoadedChunk:
    """Return the chunk with its first `parts` parts in memory, and the others mapped.

    The order is that of `memory_parts`; `MemoryBudget` determines the number.
    """
    stored = chunk.stored
    if stored is None:
        return chunk
    part = 0
    codes = None
    if stored.codes is not None:
        part = len(stored.codes.levels)
        current = (chunk.codes or stored.codes).levels
        codes = replace(
            stored.codes,
            levels=tuple(
                _in_memory(level, loaded, parts > number)
                for number, (level, loaded) in enumerate(
                    zip(stored.codes.levels, current, strict=True)
                )
            ),
            norms=np.array(stored.codes.norms),  # 4 bytes a row: always
        )
    rows: StoredRows = _in_memory(stored.rows, chunk.rows, parts > part)
    return replace(chunk, rows=rows, codes=codes)


class MemoryBudget:
    """Memory budget shared by the generations of a worker; thread-safe."""

    def __init__(self, budget_bytes: int) -> None:
        self._budget_bytes = budget_bytes
        self._lock = threading.Lock()
        self._requests: dict[UUID, Sequence[int]] = {}

    def allocate(self, generation_id: UUID, part_bytes: Sequence[int]) -> int:
        """Return how many of the generation's first parts, of these sizes, are to be resident."""
        with self._lock:
            self._requests[generation_id] = part_bytes
            return allocate_parts(self._requests, self._budget_bytes)[generation_id]

    def release_generation(self, generation_id: UUID) -> None:
        """Release the memory of a generation."""
        with self._lock:
            self._requests.pop(generation_id, None)


def allocate_parts(requests: Mapping[UUID, Sequence[int]], budget_bytes: int) -> dict[UUID, int]:
    """Return how many parts of each generation fit: all first parts before any second part."""
    counts = dict.fromkeys(requests, 0)
    remaining = budget_bytes
    for part in range(max(map(len, requests.values()), default=0)):
        for generation_id, sizes in requests.items():
            if counts[generation_id] == part < len(sizes) and sizes[part] <= remaining:
                remaining -= sizes[part]
                counts[generation_id] += 1
    return counts


def memory_parts(chunks: Sequence[LoadedChunk]) -> list[int]:
    """Return the total sizes of the chunks' index parts in bytes: levels of codes, then rows."""
    levels = [[level.nbytes for level in chunk.codes.levels] for chunk in chunks if chunk.codes]
    return [*map(sum, zip(*levels, strict=True)), sum(chunk.rows.nbytes for chunk in chunks)]


def _in_memory(stored: NDArray[Any], loaded: NDArray[Any], resident: bool) -> NDArray[Any]:
    if not resident:
        return stored
    return np.array(stored) if loaded is stored else loaded


def _write_durably(target: Path, data: bytes) -> None:
    with create_private_file(target) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
