"""A chunk from its files to what search holds of it."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.loaded_chunk import LoadedChunk, StoredChunk
from services.search.local_files import MappedFileCache
from shared.catalog.chunks import Chunk
from shared.chunks import codes_key, decode_rows
from shared.errors import NotFound
from shared.objects import ObjectStore
from shared.private_files import create_private_file

if TYPE_CHECKING:
    from shared.codes.int8 import Int8Codes
    from shared.codes.signs import SignCodes

log = logging.getLogger(__name__)

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
        from shared.codes.stored import decode_sign_codes, encode_sign_codes

        def kept(target: Path) -> None:
            _write_durably(target, self._store.get(codes_key(object_key)))

        def made(target: Path) -> None:
            _write_durably(target, encode_sign_codes(stored.rows, stored.sha256))

        return self._load_codes(object_key, stored, "codes", (kept, made), decode_sign_codes)

    def load_int8_codes(self, object_key: str, stored: StoredChunk) -> Int8Codes:
        """The chunk's int8 codes: those of the folder, or made from its rows."""
        from shared.codes.stored import decode_int8_codes, encode_int8_codes

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
