"""Chunk files: descriptor rows as an immutable `.npy` file, with the files that belong to them.

`<chunk>.npy` is a C-contiguous (rows, dimension) array, float32 or float16, each row L2-normalised
before it was rounded to that type.
`<chunk>.json`, the manifest, describes the rows (extractor spec, photo ids in row order, hash), so
that a lost catalog can be rebuilt from the object store.
`<chunk>.codes` has the sign codes that search scans first (`shared.codes`), for chunks that are
large enough.
`<chunk>.features` has the local features of the photos (`shared.storage.feature_files`), if any.
"""

from __future__ import annotations

import hashlib
import io
import json
import mmap
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.errors import Unavailable
from shared.storage import ObjectStore
from shared.storage.feature_files import FeatureRows, encode_feature_file
from shared.storage.protocol import read_up_to

Rows = NDArray[np.float32]
Row = NDArray[np.float32]
StoredRows = NDArray[np.float32] | NDArray[np.float16]

ROW_DTYPES = (np.dtype(np.float32), np.dtype(np.float16))

# Sign codes are stored with a chunk of at least this dimension and size. For smaller ones, search
# compares the rows as fast, or computes the codes quickly.
CODED_DIMENSION = 7000
CODED_BYTES = 8_000_000

# A row is a unit vector or zero. One whose norm differs by more than this is damaged.
NORM_TOLERANCE = 1e-3

CORRUPT = "chunk_corrupt"

HEADER_READ_BYTES = 1024  # enough for the header: NumPy writes 128 bytes

# NumPy parses the header as a Python literal. Python before 3.11.8 may raise SystemError if two
# threads do so at once: https://github.com/python/cpython/issues/106905
_HEADER_LOCK = threading.Lock()


@dataclass(frozen=True, slots=True)
class WrittenChunk:
    """A chunk in the object store, as the catalog registers it."""

    object_key: str
    rows: int
    size_bytes: int
    sha256: str
    features_model: str | None = None
    """`Detector.model` of the local features; None without a feature file"""
    features_rows: int = 0
    """rows with local features"""
    features_bytes: int = 0
    features_sha256: str | None = None


# Field of `WrittenChunk` -> its name in the manifest's object `features`.
MANIFEST_FEATURES = {
    "features_model": "model",
    "features_rows": "rows",
    "features_bytes": "size_bytes",
    "features_sha256": "sha256",
}


def chunk_key(generation_id: UUID, chunk_id: UUID) -> str:
    return f"chunks/{generation_id}/{chunk_id}.npy"


def manifest_key(object_key: str) -> str:
    """Return the key of a chunk's manifest."""
    return object_key.removesuffix(".npy") + ".json"


def codes_key(object_key: str) -> str:
    """Return the key of a chunk's sign codes."""
    return object_key.removesuffix(".npy") + ".codes"


def features_key(object_key: str) -> str:
    """Return the key of the local features of a chunk's photos (`shared.storage.feature_files`)."""
    return object_key.removesuffix(".npy") + ".features"


def encode_rows(rows: StoredRows) -> bytes:
    """Encode (n, dimension) float32 or float16 rows as the bytes of a `.npy` file."""
    if rows.dtype not in ROW_DTYPES or rows.ndim != 2:
        raise ValueError(f"a chunk must be 2-D float32 or float16, not {rows.ndim}-D {rows.dtype}")
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(rows), allow_pickle=False)
    return buffer.getvalue()


def decode_rows(data: bytes | mmap.mmap) -> StoredRows:
    """Decode the (rows, dimension) array of a `.npy` file as stored, without copying `data`."""
    shape, dtype, offset = _read_header(bytes(memoryview(data)[:HEADER_READ_BYTES]))
    return np.frombuffer(data, dtype=dtype, offset=offset).reshape(shape)


def _read_header(data: bytes) -> tuple[tuple[int, int], np.dtype[Any], int]:
    """Return (rows, dimension), dtype and offset of the rows; ValueError for another file."""
    buffer = io.BytesIO(data)
    shape, fortran_order, dtype = read_npy_header(buffer)
    if dtype not in ROW_DTYPES or fortran_order or len(shape) != 2:
        raise ValueError(f"not a chunk: {dtype}, shape {shape}, fortran_order={fortran_order}")
    return shape, dtype, buffer.tell()


def read_npy_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read (shape, fortran_order, dtype) of a `.npy` file, up to its data; any thread may.

    Raises ValueError for another file.
    """
    version = np.lib.format.read_magic(file)
    with _HEADER_LOCK:
        if version == (1, 0):
            return np.lib.format.read_array_header_1_0(file)
        if version == (2, 0):
            return np.lib.format.read_array_header_2_0(file)
    raise ValueError(f"the version {version} of its format is unknown")


def write_chunk(
    store: ObjectStore,
    *,
    generation_id: UUID,
    chunk_id: UUID,
    rows: StoredRows,
    photo_ids: list[UUID],
    spec: dict[str, Any],
    features: FeatureRows | None = None,
) -> WrittenChunk:
    """Write a chunk with its manifest and the files beside it to the store.

    The chunk is written last, so that it never exists without them. Registering it in the catalog
    is up to the caller.

    Args:
        rows: (n, dimension) float32 or float16, L2-normalised.
        photo_ids: the photo of each row.
        spec: the extractor spec, part of the manifest.
        features: the local features of the photos, row by row; no file is written if all are empty.
    """
    feature_rows = features.rows if features else [b""] * len(rows)
    if not len(photo_ids) == len(feature_rows) == len(rows):
        raise ValueError(f"{len(rows)} rows for {len(photo_ids)} photos")
    data = encode_rows(rows)
    sha256 = hashlib.sha256(data).hexdigest()
    key = chunk_key(generation_id, chunk_id)
    manifest: dict[str, Any] = {
        "format": 1,
        "chunk_id": str(chunk_id),
        "generation_id": str(generation_id),
        "spec": spec,
        "rows": len(rows),
        "dimension": rows.shape[1],
        "sha256": sha256,
        "photo_ids": [str(photo_id) for photo_id in photo_ids],
    }
    written = WrittenChunk(object_key=key, rows=len(rows), size_bytes=len(data), sha256=sha256)
    if features and any(feature_rows):
        feature_file = encode_feature_file(features, features_key(key))
        written = replace(
            written,
            features_model=features.model,
            features_rows=sum(map(bool, feature_rows)),
            features_bytes=len(feature_file),
            features_sha256=hashlib.sha256(feature_file).hexdigest(),
        )
        manifest["features"] = {
            name: getattr(written, field) for field, name in MANIFEST_FEATURES.items()
        }
        store.put(features_key(key), feature_file)
    store.put(manifest_key(key), json.dumps(manifest).encode())
    if rows.shape[1] >= CODED_DIMENSION and rows.nbytes >= CODED_BYTES:
        from shared.codes.serialization import encode_sign_codes  # importing numba is slow

        store.put(codes_key(key), encode_sign_codes(rows, sha256))
    store.put(key, data)
    return written


@dataclass(frozen=True, slots=True)
class ChunkManifest:
    """What the manifest of a chunk says; `photo_ids` has the photo of each row."""

    chunk_id: UUID
    generation_id: UUID
    sha256: str
    photo_ids: list[UUID]
    features: dict[str, Any]
    """the fields `features_*` of `WrittenChunk`; empty without a feature file"""


def read_manifest(store: ObjectStore, object_key: str) -> ChunkManifest | None:
    """Return the manifest of a chunk; None if it can't be read, NotFound if it is missing."""
    try:
        content = json.loads(store.get(manifest_key(object_key)))
        stored = content.get("features") or {}
        features = {field: stored[name] for field, name in MANIFEST_FEATURES.items() if stored}
        return ChunkManifest(
            UUID(content["chunk_id"]),
            UUID(content["generation_id"]),
            str(content["sha256"]),
            [UUID(photo_id) for photo_id in content["photo_ids"]],
            features,
        )
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def read_chunk(store: ObjectStore, object_key: str, sha256: str) -> StoredRows:
    """Read a chunk as stored, and verify its hash; Unavailable (`chunk_corrupt`) if it differs."""
    data = store.get(object_key)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise chunk_corrupt_error(object_key)
    return decode_rows(data)


def chunk_corrupt_error(object_key: str) -> Unavailable:
    """Return the error for a chunk whose bytes do not match its hash."""
    return Unavailable(
        CORRUPT,
        f"The chunk {object_key} is damaged (its hash differs). "
        "Restore the object from a backup, or describe its photos again: placewise storage verify "
        "--repair.",
        object_key=object_key,
    )


def read_row(store: ObjectStore, object_key: str, row: int) -> Row:
    """Read one row of a chunk, (dimension,); otherwise as `read_rows`."""
    vector: Row = read_rows(store, object_key, [row])[0]
    return vector


def read_rows(store: ObjectStore, object_key: str, rows: Sequence[int]) -> Rows:
    """Read single rows of a chunk with range requests.

    The hash is not verified, since it covers the whole chunk.

    Returns:
        (n, dimension) float32, in the order of `rows`; float16 rows are converted.

    Raises:
        IndexError: the chunk has no such row.
        ValueError: the object is not a chunk, or is truncated.
        NotFound: the object is missing.
    """
    with store.open(object_key) as file:
        (row_count, dimension), dtype, offset = _read_header(read_up_to(file, HEADER_READ_BYTES))
        size = dimension * dtype.itemsize
        vectors = np.empty((len(rows), dimension), dtype=np.float32)
        for position, row in enumerate(rows):
            if row >= row_count:
                raise IndexError(row)
            file.seek(offset + row * size)
            data = read_up_to(file, size)
            if len(data) < size:
                raise ValueError(f"the object is {size - len(data)} bytes too short")
            vectors[position] = np.frombuffer(data, dtype=dtype)
    return vectors


def rows_are_valid(rows: StoredRows) -> NDArray[np.bool_]:
    """Return an (n,) mask of the (n, dimension) rows that are unit vectors or zero."""
    norms = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float32))
    return np.asarray((norms == 0) | (np.abs(norms - 1) < NORM_TOLERANCE))


def delete_chunk(store: ObjectStore, object_key: str) -> None:
    """Delete a chunk and the files beside it."""
    store.delete(object_key)
    store.delete(codes_key(object_key))
    store.delete(features_key(object_key))
    store.delete(manifest_key(object_key))
