"""The rows that a PCA is fitted on: how many, and how they are read, by blocks of columns.

Fitting a PCA whitening (`shared.descriptors.pca_whitening`) on database rows: queries would
tell the map what
they are.

At 98,304 dimensions the covariance (39 GB) can't be held. With fewer rows than dimensions the same
directions come from the n x n Gram matrix (Turk and Pentland 1991): XX' = U diag(s^2) U' gives
l = s^2 / (n - 1) and p = X'u / s. X is read in blocks of columns, each centred by its own mean,
once for XX' and once for the directions, so that memory holds n x n numbers, one block, and what
comes of it. Each block is a step, and a fit can be interrupted between any two.

A whitening from rows that come batch by batch: they lie in a temporary folder meanwhile.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shared.descriptors.pca_whitening import PcaWhitening, Rows
from shared.errors import Unprocessable
from shared.storage import FolderStore, ObjectStore

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


# Of the largest one: below, float32's rounding of the rows is what would be made strong.
MIN_VARIANCE = 1e-9

Matrix = NDArray[np.float64]


class PcaFitStage(StrEnum):
    PRODUCTS = "products"  # between all rows
    VARIANCES = "variances"  # the largest of them
    DIRECTIONS = "directions"
    DONE = "done"


@dataclass(frozen=True, slots=True, eq=False)
class PcaBlock:
    """A block of columns of the result."""

    mean: Rows
    """(width,)"""
    directions: Rows
    """(kept, width), each divided by its standard deviation."""


class PcaFit:
    """Finds a whitening; `step` until `done`. The same for the same rows, whether or not it was
    saved and resumed between two steps.
    """

    def __init__(self, rows: ColumnSource, kept: int) -> None:
        """Raises Unprocessable as `check_pca_fittable` does."""
        check_pca_fittable(rows.count, rows.dimension, kept)
        self._rows = rows
        self._kept = kept
        self._blocks = block_count(rows)
        self.stage = PcaFitStage.PRODUCTS
        self._block = 0
        """Blocks of columns that the stage has seen."""
        # Of rows (XX') or of columns (X'X), whichever are fewer.
        self._by_columns = rows.count > rows.dimension and self._blocks == 1
        size = rows.dimension if self._by_columns else rows.count
        self._products: Matrix = np.zeros((size, size))
        self._basis: Matrix = np.empty((size, 0))
        """What a centred block is multiplied with for its directions."""
        self._variances: Matrix = np.empty(0)
        self._total = 0.0

    @property
    def done(self) -> bool:
        return self.stage == PcaFitStage.DONE

    @property
    def progress(self) -> tuple[int, int]:
        """Steps done, and all of them."""
        before = {
            PcaFitStage.PRODUCTS: 0,
            PcaFitStage.VARIANCES: 0,
            PcaFitStage.DIRECTIONS: self._blocks + 1,
        }
        most = 2 * self._blocks + 1
        return (most if self.done else before[self.stage] + self._block), most

    @property
    def parts(self) -> int:
        """Blocks of the result that there are."""
        if self.done:
            return self._blocks
        return self._block if self.stage == PcaFitStage.DIRECTIONS else 0

    def step(self) -> PcaBlock | None:
        """A block of columns, or the variances; of the last stage, what came of the block.

        Unprocessable (`pca_too_many_dimensions`) when the rows vary in too few directions.
        """
        if self.stage == PcaFitStage.VARIANCES:
            self._find_variances()
            return None
        block, mean = _centred(self._rows.read(self._block))
        part = None
        if self.stage == PcaFitStage.PRODUCTS:
            self._products += block.T @ block if self._by_columns else block @ block.T
        else:
            found = self._basis.T if self._by_columns else self._basis.T @ block
            part = PcaBlock(mean.astype(np.float32), found.astype(np.float32))
        self._block += 1
        if self._block == self._blocks:
            if self.stage == PcaFitStage.DIRECTIONS:
                self.stage = PcaFitStage.DONE
            else:
                self.stage = PcaFitStage.VARIANCES
        return part

    def whitening(self, parts: Sequence[PcaBlock]) -> PcaWhitening:
        """What the parts of a fit that is done come to, in their order."""
        assert self.done
        directions = np.concatenate([part.directions for part in parts], axis=1)
        return PcaWhitening(
            mean=np.concatenate([part.mean for part in parts]),
            directions=_with_fixed_signs(directions),
            variances=self._variances.astype(np.float32),
            explained=float(self._variances.sum() / self._total),
            rows=self._rows.count,
        )

    def _find_variances(self) -> None:
        freedom = self._rows.count - 1
        squares, vectors = _largest_eigenpairs(self._products, self._kept)
        self._variances = squares / freedom
        self._total = float(np.trace(self._products)) / freedom
        # p / sqrt(l) = X'u / s * sqrt(n - 1) / s; by columns the vectors are the directions p.
        scale = 1 / np.sqrt(self._variances) if self._by_columns else np.sqrt(freedom) / squares
        self._basis = vectors * scale
        self._products = np.empty((0, 0))
        self.stage, self._block = PcaFitStage.DIRECTIONS, 0

    # --- between two steps ---------------------------------------------------------------------

    def save(self) -> bytes:
        """All that `resume` needs beside the same rows and the parts that there are."""
        arrays: dict[str, Any] = {
            "stage": np.array(str(self.stage)),
            "block": np.array(self._block),
            "products": self._products,
            "basis": self._basis,
            "variances": self._variances,
            "total": np.array(self._total),
        }
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()

    def resume(self, data: bytes) -> None:
        """Go on where a fit of the same rows was saved."""
        with np.load(io.BytesIO(data), allow_pickle=False) as saved:
            self.stage = PcaFitStage(str(saved["stage"]))
            self._block = int(saved["block"])
            self._products, self._basis = saved["products"], saved["basis"]
            self._variances, self._total = saved["variances"], float(saved["total"])


def check_pca_fittable(rows: int, dimension: int, kept: int) -> None:
    """Unprocessable: `pca_too_few_rows` unless there are more than `kept`;
    `pca_too_many_dimensions` when they have fewer dimensions.
    """
    if kept > dimension:
        raise Unprocessable(
            "pca_too_many_dimensions",
            f"Descriptors of {dimension} dimensions can't be brought to {kept}. Take fewer.",
        )
    if rows <= kept:
        raise Unprocessable(
            "pca_too_few_rows",
            f"PCA to {kept} dimensions needs more than {kept} described photos, better several "
            f"times as many, and there are {rows}. Index more photos, or take fewer dimensions.",
        )


def fit_pca(rows: Rows, kept: int, *, block_bytes: int = BLOCK_BYTES) -> PcaWhitening:
    """The whitening of (n, D) rows, which may be mapped from a file, to `kept` dimensions.

    Raises as `PcaFit` does.
    """
    return fit_pca_columns(ArrayColumns(rows, block_bytes), kept)


def fit_pca_columns(
    rows: ColumnSource, kept: int, on_progress: Callable[[int, int], None] = lambda done, most: None
) -> PcaWhitening:
    """The whitening of rows to `kept` dimensions in one go; `on_progress` hears how many steps
    are done,
    and of how many."""
    finding = PcaFit(rows, kept)
    parts = []
    while not finding.done:
        part = finding.step()
        if part is not None:
            parts.append(part)
        on_progress(*finding.progress)
    return finding.whitening(parts)


def _largest_eigenpairs(matrix: Matrix, kept: int) -> tuple[Matrix, Matrix]:
    """The `kept` largest eigenvalues, largest first, and their (N, kept) unit eigenvectors."""
    values, vectors = np.linalg.eigh(matrix)
    values, vectors = values[::-1][:kept], vectors[:, ::-1][:, :kept]
    usable = int((values > MIN_VARIANCE * max(values[0], 0)).sum())
    if usable < kept:
        raise Unprocessable(
            "pca_too_many_dimensions",
            f"The described photos vary in {usable} directions only, and PCA to {kept} dimensions "
            "needs as many. Index more different photos, or take fewer dimensions.",
        )
    return values, vectors


def _centred(block: Rows) -> tuple[Matrix, Matrix]:
    """The columns without their means, in float64, and the means."""
    wide = block.astype(np.float64)
    means: Matrix = wide.mean(axis=0)
    wide -= means
    return wide, means


def _with_fixed_signs(directions: Rows) -> Rows:
    """Of two opposite directions the one whose strongest number is positive: the same everywhere,
    whichever way the eigenvectors came. (kept, D), C order.
    """
    fixed = np.ascontiguousarray(directions)
    for direction in fixed:
        if direction[np.abs(direction).argmax()] < 0:
            # Not np.negative in place: NumPy 2.4 does it wrong where rows are strided by 16 bytes.
            direction *= -1
    return fixed


ROWS_FOLDER_PREFIX = "rows-"


def fit_pca_stream(
    batches: Iterable[Rows],
    max_rows: int,
    dimension: int,
    kept: int,
    on_progress: Callable[[str, int, int], None] = lambda what, done, max_rows: None,
) -> PcaWhitening:
    """The whitening to `kept` dimensions of at most `max_rows` rows, in batches of (n, dimension).

    Rows that say nothing of their photo are passed over. `on_progress` hears what is being done
    (`gathering`, `reducing`), how far it is and where it ends. Raises as `PcaFit` does.
    """
    with tempfile.TemporaryDirectory(prefix="placewise-pca-") as folder:
        store = FolderStore(Path(folder))
        stored = StoredColumns(
            store, ROWS_FOLDER_PREFIX, dimension, block_width(max_rows, dimension)
        )
        seen = 0
        for batch in batches:
            rows = batch[usable_rows(batch)]
            if len(rows):
                stored.add(rows)
            seen += len(batch)
            on_progress("gathering", seen, max_rows)
        return fit_pca_columns(
            stored, kept, lambda done, steps: on_progress("reducing", done, steps)
        )
