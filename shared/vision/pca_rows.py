"""The rows that a PCA is fitted on: how many, and how they are read, by blocks of columns."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared.objects import ObjectStore
from shared.vision.pca import Rows

BLOCK_BYTES = 64_000_000  # of float64 columns that are looked at together
SAMPLE_BYTES = 1_000_000_000  # of rows, where they lie while a fit works on them
MIN_SAMPLE_ROWS = 1000
SAMPLE_PER_DIMENSION = 4
FLOAT32 = np.dtype("<f4")


def sample_size(dimension: int, kept: int) -> int:
    """How many rows of `dimension` numbers a fit to `kept` learns from, at most.

    Several for each direction that is kept, as far as SAMPLE_BYTES go, but always twice as many:
    the time that a fit takes grows with the square of their number.
    """
    wanted = max(MIN_SAMPLE_ROWS, SAMPLE_PER_DIMENSION * kept)
    return min(wanted, max(2 * kept, SAMPLE_BYTES // (FLOAT32.itemsize * dimension)))


def sample_rows(available: int, sample: int, seed: int) -> NDArray[np.int64]:
    """Which of so many rows to learn from, at most `sample`: their numbers, ascending."""
    chosen = np.random.default_rng(seed).choice(
        available, size=min(sample, available), replace=False
    )
    return np.sort(chosen)


def usable_rows(rows: Rows) -> NDArray[np.bool_]:
    """(n,) which of (n, D) rows say something of their photo: neither zero nor with a NaN."""
    lengths = np.linalg.norm(rows, axis=1)
    return np.asarray(np.isfinite(lengths) & (lengths > 0))


class ColumnSource(Protocol):
    """(count, dimension) float32 rows that are read by columns."""

    @property
    def count(self) -> int: ...

    @property
    def dimension(self) -> int: ...

    @property
    def width(self) -> int:
        """Of a block of columns; the last one may be narrower."""

    def read(self, block: int) -> Rows:
        """(count, width) of the block, the first being 0."""


def block_count(rows: ColumnSource) -> int:
    """How many blocks of columns there are."""
    return -(-rows.dimension // rows.width)


def block_width(count: int, dimension: int, block_bytes: int = BLOCK_BYTES) -> int:
    """How many columns of (count, dimension) rows are looked at together.

    All, where there are more rows than dimensions: the products of columns are fewer then.
    """
    if count > dimension:
        return dimension
    return min(dimension, max(1, block_bytes // (8 * max(1, count))))


class ArrayColumns:
    """Those of an array, which may be mapped from a file."""

    def __init__(self, rows: Rows, block_bytes: int = BLOCK_BYTES) -> None:
        self._rows = rows
        self.count, self.dimension = rows.shape
        self.width = block_width(self.count, self.dimension, block_bytes)

    def read(self, block: int) -> Rows:
        begin = block * self.width
        return self._rows[:, begin : begin + self.width]


class StoredColumns:
    """Rows in an object store, as objects `PREFIX<block>-<first row>.f32`: (rows, width) float32,
    little-endian, C order. So a block of columns is read without the others.
    """

    def __init__(
        self, store: ObjectStore, prefix: str, dimension: int, width: int, count: int = 0
    ) -> None:
        """`width`: of a block, as `block_width` gives it for as many rows as there may be; `count`:
        rows that are there already.
        """
        self._store = store
        self._prefix = prefix
        self.dimension = dimension
        self.width = width
        self.count = count

    def add(self, rows: Rows) -> None:
        """Keep (n, dimension) more rows. Those that were added before a crash, and not counted, are
        written again.
        """
        for block in range(block_count(self)):
            begin = block * self.width
            piece = rows[:, begin : begin + self.width].astype(FLOAT32)
            self._store.put(self._key(block, self.count), piece.tobytes())
        self.count += len(rows)

    def read(self, block: int) -> Rows:
        width = min(self.width, self.dimension - block * self.width)
        rows = np.empty((self.count, width), np.float32)
        filled = 0
        while filled < self.count:
            data = self._store.get(self._key(block, filled))
            piece = np.frombuffer(data, FLOAT32).reshape(-1, width)
            rows[filled : filled + len(piece)] = piece
            filled += len(piece)
        return rows

    def _key(self, block: int, first: int) -> str:
        return f"{self._prefix}{block:05d}-{first:08d}.f32"
