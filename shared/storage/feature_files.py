"""Feature files: the local features of a chunk's photos, row by row, beside the chunk.

`<chunk>.features` is, in this order:

    the bytes PWF1, and the length of the header as a little-endian uint32
    the header, JSON: {"format": 1, "model": "xfeat@...", "rows": n, "name": "<chunk>.features"}
    n + 1 little-endian uint64: where each row begins, from the start of the file
    the rows, each as `LocalFeatures.encode` writes it

Row i has the features of the photo of row i of the chunk; it is empty where none were computed.
Rows are read by range. The name tells a file that was put in the place of another one.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from shared.storage import ObjectStore
from shared.storage.protocol import read_up_to

MAGIC = b"PWF1"
MAX_HEADER_BYTES = 4096
MAX_ROWS = 1 << 24
MAX_ROW_BYTES = 1 << 22
_START = struct.Struct("<4sI")


@dataclass(frozen=True, slots=True, eq=False)
class FeatureIndex:
    """The start of a feature file."""

    model: str
    """`Detector.model`"""
    offsets: NDArray[np.uint64]
    """(n + 1,) where each row begins"""

    @property
    def rows(self) -> int:
        return len(self.offsets) - 1

    def row_range(self, row: int) -> tuple[int, int]:
        """Return where a row begins and ends; an empty range if there is no such row."""
        if row >= self.rows:
            return 0, 0
        begin, end = self.offsets[row : row + 2].tolist()
        return begin, end


@dataclass(frozen=True, slots=True)
class FeatureRows:
    """The content of a feature file."""

    model: str
    """`Detector.model`"""
    rows: Sequence[bytes | memoryview]
    """encoded features by row; empty for photos without"""


def encode_feature_file(features: FeatureRows, key: str) -> bytes:
    """Encode a feature file that will be stored as `key`."""
    name, sizes = key.rpartition("/")[2], list(map(len, features.rows))
    fields = {"format": 1, "model": features.model, "rows": len(sizes), "name": name}
    header = json.dumps(fields).encode()
    start = _START.pack(MAGIC, len(header)) + header
    offsets = np.cumsum([len(start) + 8 * (len(sizes) + 1), *sizes])
    return b"".join([start, offsets.astype("<u8").tobytes(), *features.rows])


def read_feature_index(store: ObjectStore, key: str) -> FeatureIndex:
    """Read the start of a feature file.

    Raises:
        ValueError: The object is no feature file, or is damaged.
        NotFound: The object is missing.
    """
    with store.open(key) as file:
        return _read_index(file, key)


def _read_index(file: BinaryIO, key: str) -> FeatureIndex:
    start = read_up_to(file, _START.size)
    magic, size = _START.unpack(start) if len(start) == _START.size else (b"", 0)
    if magic != MAGIC or size > MAX_HEADER_BYTES:
        raise ValueError(f"{key} is not a feature file")
    try:
        header = json.loads(read_up_to(file, size))
        model, rows = str(header["model"]), int(header["rows"])
        name = header["name"]
    except (KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"the header of {key} is damaged") from error
    if name != key.rpartition("/")[2]:
        raise ValueError(f"{key} has the content of {name!r:.100}")
    offsets = np.frombuffer(read_up_to(file, 8 * (min(rows, MAX_ROWS) + 1)), "<u8")
    sizes = np.diff(offsets.astype(np.int64))
    if len(sizes) != rows or ((sizes < 0) | (sizes > MAX_ROW_BYTES)).any():
        raise ValueError(f"the offsets of {key} are damaged")
    return FeatureIndex(model, offsets)


def read_feature_rows(
    store: ObjectStore, key: str, index: FeatureIndex, rows: Iterable[int]
) -> dict[int, bytes]:
    """Read single rows by range; rows without features, or beyond the end, are left out.

    Raises:
        ValueError: The file is truncated.
        NotFound: The object is missing.
    """
    found = {}
    with store.open(key) as file:
        for row in sorted(set(rows)):
            begin, end = index.row_range(row)
            if begin == end:
                continue
            file.seek(begin)
            found[row] = read_up_to(file, end - begin)
            if len(found[row]) < end - begin:
                raise ValueError(f"{key} is too short")
    return found


def read_feature_file(store: ObjectStore, key: str, sha256: str | None) -> FeatureRows:
    """Read a whole feature file, and verify its hash.

    Raises:
        ValueError: The file is damaged.
        NotFound: The object is missing.
    """
    data = store.get(key)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise ValueError("its hash differs")
    index, view = _read_index(io.BytesIO(data), key), memoryview(data)
    return FeatureRows(
        index.model, [view[begin:end] for begin, end in pairwise(index.offsets.tolist())]
    )
