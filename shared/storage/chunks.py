"""The chunk format: descriptor rows as an immutable `.npy` file with a `.json` beside it.

`<chunk>.npy` is a C-contiguous (rows, dimension) array, float32, each row L2-normalised.
`<chunk>.json` says what the rows are (spec, photo ids in row order, hash), so that a lost catalog
can be rebuilt from the object store.
`<chunk>.codes` holds the codes that search begins with (`shared.codes`), of chunks that are long
enough to need any.
"""

from __future__ import annotations

import hashlib
import io
import json
import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.errors import Unavailable
from shared.storage import ObjectStore

Rows = NDArray[np.float32]
Row = NDArray[np.float32]

# From these on, codes lie beside a chunk: below, search compares rows as fast, or makes the few
# codes in no time.
CODED_DIMENSION = 7000
CODED_BYTES = 8_000_000

# Rows are unit vectors, or zero: with a length further off than this, one is damaged.
NORM_TOLERANCE = 1e-3

CORRUPT = "chunk_corrupt"

CORRUPT = "chunk_corrupt"

HEADER_READ_BYTES = 1024  # what is read to find out where the rows begin: NumPy's header has 128


@dataclass(frozen=True, slots=True)
class WrittenChunk:
    """What the catalog has to know of a chunk that lies in the object store."""

    object_key: str
    rows: int
    size_bytes: int
    sha256: str


def chunk_key(generation_id: UUID, chunk_id: UUID) -> str:
    return f"chunks/{generation_id}/{chunk_id}.npy"


def manifest_key(object_key: str) -> str:
    """The key of the `.json` beside a chunk."""
    return object_key.removesuffix(".npy") + ".json"


def codes_key(object_key: str) -> str:
    """The key of the codes beside a chunk."""
    return object_key.removesuffix(".npy") + ".codes"


def encode_rows(rows: Rows) -> bytes:
    """(n, dimension) float32 rows as the bytes of a `.npy` file."""
    if rows.dtype != np.float32 or rows.ndim != 2:
        raise ValueError(f"a chunk is 2-D float32, not {rows.ndim}-D {rows.dtype}")
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(rows), allow_pickle=False)
    return buffer.getvalue()


def decode_rows(data: bytes | mmap.mmap) -> Rows:
    """The rows of a `.npy` file, sharing memory with `data`."""
    shape, offset = _read_header(bytes(memoryview(data)[:HEADER_READ_BYTES]))
    return np.frombuffer(data, dtype=np.float32, offset=offset).reshape(shape)


def _read_header(data: bytes) -> tuple[tuple[int, int], int]:
    """(rows, dimension), and where the rows begin. ValueError when it is no chunk's."""
    buffer = io.BytesIO(data)
    major, _ = np.lib.format.read_magic(buffer)
    read_header = {
        1: np.lib.format.read_array_header_1_0,
        2: np.lib.format.read_array_header_2_0,
    }[major]
    shape, fortran_order, dtype = read_header(buffer)
    if dtype != np.float32 or fortran_order or len(shape) != 2:
        raise ValueError(f"not a chunk: {dtype}, shape {shape}, fortran_order={fortran_order}")
    return shape, buffer.tell()


def write_chunk(
    store: ObjectStore,
    *,
    generation_id: UUID,
    chunk_id: UUID,
    rows: Rows,
    photo_ids: list[UUID],
    spec: dict[str, Any],
) -> WrittenChunk:
    """Put the chunk and its manifest into the store; the catalog does not know of them yet.

    The chunk goes last: it never lies there without its description.
    """
    if len(photo_ids) != len(rows):
        raise ValueError(f"{len(rows)} rows for {len(photo_ids)} photos")
    data = encode_rows(rows)
    sha256 = hashlib.sha256(data).hexdigest()
    key = chunk_key(generation_id, chunk_id)
    manifest = {
        "format": 1,
        "chunk_id": str(chunk_id),
        "generation_id": str(generation_id),
        "spec": spec,
        "rows": len(rows),
        "dimension": rows.shape[1],
        "sha256": sha256,
        "photo_ids": [str(photo_id) for photo_id in photo_ids],
    }
    store.put(manifest_key(key), json.dumps(manifest).encode())
    if rows.shape[1] >= CODED_DIMENSION and rows.nbytes >= CODED_BYTES:
        from shared.codes.serialization import encode_sign_codes  # numba takes a while to load

        store.put(codes_key(key), encode_sign_codes(rows, sha256))
    store.put(key, data)
    return WrittenChunk(object_key=key, rows=len(rows), size_bytes=len(data), sha256=sha256)


def read_chunk(store: ObjectStore, object_key: str, sha256: str) -> Rows:
    """The chunk's rows, checked against the catalog's hash; Unavailable when they differ."""
    data = store.get(object_key)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise chunk_corrupt_error(object_key)
    return decode_rows(data)


def chunk_corrupt_error(object_key: str) -> Unavailable:
    """A chunk's bytes are not those of its hash."""
    return Unavailable(
        CORRUPT,
        f"The chunk {object_key} is not what was written (its hash differs). "
        "Restore the object from a backup, or describe its photos again: placewise verify "
        "--repair.",
        object_key=object_key,
    )


def read_row(store: ObjectStore, object_key: str, row: int) -> Row:
    """One row of a chunk, (dimension,); otherwise as `read_rows`."""
    found: Row = read_rows(store, object_key, [row])[0]
    return found


def read_rows(store: ObjectStore, object_key: str, rows: Sequence[int]) -> Rows:
    """These rows of a chunk, (n, dimension) in their order, fetching little more than them.

    No hash is checked: that of a chunk is of all its bytes. IndexError when there is no such row,
    ValueError for what is no chunk or ends too early, NotFound when the object is missing.
    """
    with store.open(object_key) as file:
        (there, dimension), offset = _read_header(_read_up_to(file, HEADER_READ_BYTES))
        size = dimension * np.dtype(np.float32).itemsize
        found = np.empty((len(rows), dimension), dtype=np.float32)
        for place, row in enumerate(rows):
            if row >= there:
                raise IndexError(row)
            file.seek(offset + row * size)
            data = _read_up_to(file, size)
            if len(data) < size:
                raise ValueError(f"the object ends {size - len(data)} bytes too early")
            found[place] = np.frombuffer(data, dtype=np.float32)
    return found


def rows_are_valid(rows: Rows) -> NDArray[np.bool_]:
    """(n,) which of (n, dimension) rows can be what was written: those of length 1, or zero."""
    lengths = np.linalg.norm(rows, axis=1)
    return np.asarray((lengths == 0) | (np.abs(lengths - 1) < NORM_TOLERANCE))


def _read_up_to(file: BinaryIO, size: int) -> bytes:
    """Up to `size` bytes; fewer only at the end. (A network's file may give less at a time.)"""
    pieces = []
    while size and (piece := file.read(size)):
        pieces.append(piece)
        size -= len(piece)
    return b"".join(pieces)


def delete_chunk(store: ObjectStore, object_key: str) -> None:
    """Remove the chunk, its codes and its manifest."""
    store.delete(object_key)
    store.delete(codes_key(object_key))
    store.delete(manifest_key(object_key))
