"""A chunk from its files to what search holds of it.

A chunk as a search worker has it: rows, what is known of their photos, and codes.

Objects as files of this machine, mapped into memory: the operating system reads what is used.

Where objects are files already, they are mapped where they lie. Elsewhere they are fetched into a
cache folder, which any number of search workers of this machine may share.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import mmap
import os
import shutil
import sys
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.photo_columns import PhotoColumns
from shared.catalog.chunks import Chunk
from shared.config.private_files import create_private_file, make_private_folder
from shared.errors import NotFound
from shared.ids import new_id
from shared.storage import ObjectStore
from shared.storage.chunks import Rows, chunk_corrupt_error, codes_key, decode_rows

if TYPE_CHECKING:
    from shared.codes.int8_codes import Int8Codes
    from shared.codes.sign_codes import SignCodes


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


@dataclass(frozen=True, slots=True, eq=False)
class LoadedChunk:
    """A chunk's rows, (n, dimension) float32, and what is known of their photos."""

    chunk_id: UUID
    object_key: str
    rows: Rows
    photos: PhotoColumns
    codes: SignCodes | None = None
    """None while search does without."""
    stored: StoredChunk | None = None
    """Where rows and codes lie on the disk; None for rows that were never there."""
    int8: Int8Codes | None = None
    """None while search does without."""

    def was_changed(self) -> bool:
        """Whether its file was damaged since it was mapped (`Mapped.was_changed`)."""
        return self.stored is not None and self.stored.file.was_changed()

    def prefetch_row(self, row: int) -> None:
        """Say that a row is read next, where it is mapped from a file."""
        if self.stored is not None and self.rows is self.stored.rows:
            size_bytes = self.rows.strides[0]
            begin = self.stored.file.size_bytes - self.rows.nbytes  # a header goes before
            self.stored.file.prefetch(begin + row * size_bytes, size_bytes)


@dataclass(frozen=True, slots=True, eq=False)
class StoredChunk:
    """A chunk's files, mapped into memory."""

    file: MappedFile
    rows: Rows
    sha256: str
    codes: SignCodes | None = None
    int8: Int8Codes | None = None


CACHED_SUFFIXES = (".npy", ".codes", ".int8")  # of a chunk's files in the folder

Number = TypeVar("Number", bound=np.generic)
Codes = TypeVar("Codes")


class ChunkLoader:
    """Opens the chunks of one generation."""

    def __init__(self, store: ObjectStore, folder: Path) -> None:
        """`folder` is the generation's own: for objects that are no files of this machine, and for
        codes that are missing."""
        self._store = store
        self._files = MappedFileCache(store, folder)

    def load_rows(self, chunk: Chunk) -> StoredChunk:
        """The chunk without codes. Unavailable, NotFound, OSError or ValueError: it can't be read.

        Its hash was checked.
        """
        file = self._files.map_object(chunk.object_key, chunk.sha256)
        return StoredChunk(file, decode_rows(file.memory), chunk.sha256)

    def load_sign_codes(self, object_key: str, stored: StoredChunk) -> SignCodes:
        """The chunk's sign codes: those beside it, or made from its rows where there are none."""
        from shared.codes.serialization import decode_sign_codes, encode_sign_codes

        def kept(target: Path) -> None:
            _write_durably(target, self._store.get(codes_key(object_key)))

        def made(target: Path) -> None:
            _write_durably(target, encode_sign_codes(stored.rows, stored.sha256))

        return self._load_codes(object_key, stored, "codes", (kept, made), decode_sign_codes)

    def load_int8_codes(self, object_key: str, stored: StoredChunk) -> Int8Codes:
        """The chunk's int8 codes: those of the folder, or made from its rows."""
        from shared.codes.serialization import decode_int8_codes, encode_int8_codes

        def made(target: Path) -> None:
            _write_durably(target, encode_int8_codes(stored.rows, stored.sha256))

        # Twice: what is there may be damaged.
        return self._load_codes(object_key, stored, "int8", (made, made), decode_int8_codes)

    def _load_codes(
        self,
        object_key: str,
        stored: StoredChunk,
        ending: str,
        ways: Sequence[Callable[[Path], None]],
        decode: Callable[..., Codes],
    ) -> Codes:
        """Codes of the folder, which the ways to make them are tried for, one after the other."""
        name = f"{stored.sha256}.{ending}"
        rows, dimension = stored.rows.shape
        for make in ways:
            try:
                file = self._files.map_or_create(name, make)
                return decode(
                    file.memory, rows=rows, dimension=dimension, chunk_sha256=stored.sha256
                )
            except NotFound:
                continue
            except ValueError as error:
                log.warning("the codes of %s are made again: %s", object_key, error)
                self._files.evict(name)
        raise AssertionError("codes that were just made are those of the rows")

    def evict_except(self, chunks: Collection[LoadedChunk]) -> None:
        """Remove the files of all other chunks."""
        hashes = [chunk.stored.sha256 for chunk in chunks if chunk.stored is not None]
        self._files.evict_except({f"{one}{end}" for one in hashes for end in CACHED_SUFFIXES})


def generation_loader(store: ObjectStore, folder: Path, generation_id: UUID) -> ChunkLoader:
    """The loader of a generation, whose files lie below `folder`."""
    return ChunkLoader(store, folder / str(generation_id))


def remove_stale_folders(folder: Path, generation_ids: Collection[UUID]) -> None:
    """Remove what loaders have kept below `folder` of generations that are gone."""
    known = {str(generation_id) for generation_id in generation_ids}
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name not in known:
            log.info("removing what was kept of generation %s", path.name)
            shutil.rmtree(path, ignore_errors=True)


def hold_in_memory(chunk: LoadedChunk, parts: int) -> LoadedChunk:
    """The chunk with its first so many parts in memory, the others mapped (`MemoryBudget`)."""
    stored = chunk.stored
    if stored is None:
        return chunk
    held = 0
    codes = None
    if stored.codes is not None:
        held = len(stored.codes.levels)
        now = (chunk.codes or stored.codes).levels
        codes = replace(
            stored.codes,
            levels=tuple(
                _in_memory(level, there, parts > number)
                for number, (level, there) in enumerate(zip(stored.codes.levels, now, strict=True))
            ),
            norms=np.array(stored.codes.norms),  # 4 bytes a row: always
        )
    int8 = None
    if stored.int8 is not None:
        there = (chunk.int8 or stored.int8).numbers
        int8 = replace(stored.int8, numbers=_in_memory(stored.int8.numbers, there, parts > held))
        held += 1
    rows = _in_memory(stored.rows, chunk.rows, parts > held)
    return replace(chunk, rows=rows, codes=codes, int8=int8)


def memory_parts(chunks: Sequence[LoadedChunk]) -> list[tuple[str, int]]:
    """The parts that these chunks have together, with their sizes in bytes."""
    sizes: dict[str, int] = {}
    for chunk in chunks:
        levels = chunk.codes.levels if chunk.codes else ()
        for number, level in enumerate(levels):
            name = f"codes {number}"
            sizes[name] = sizes.get(name, 0) + level.nbytes
        if chunk.int8 is not None:
            sizes["int8 codes"] = sizes.get("int8 codes", 0) + chunk.int8.numbers.nbytes
    return [*sizes.items(), ("rows", sum(chunk.rows.nbytes for chunk in chunks))]


def _in_memory(stored: NDArray[Number], now: NDArray[Number], wanted: bool) -> NDArray[Number]:
    if not wanted:
        return stored
    return np.array(stored) if now is stored else now


def _write_durably(target: Path, data: bytes) -> None:
    with create_private_file(target) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
