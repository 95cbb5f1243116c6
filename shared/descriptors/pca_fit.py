"""PCA fit: computes a PCA whitening from descriptor rows, by blocks of columns.

Fit on database rows only: queries of an evaluation would leak into the projection.

At 98,304 dimensions the covariance (39 GB) does not fit memory. With fewer rows than dimensions the
same directions come from the n x n Gram matrix (Turk and Pentland 1991): XX' = U diag(s^2) U' gives
l = s^2 / (n - 1) and p = X'u / s. X is read in blocks of columns, each centred by its own mean,
once for XX' and once for the directions, so that memory holds n x n numbers, one block and its
result. Each block is a step.
scikit-learn's IncrementalPCA reads batches of rows and holds a matrix of components in memory.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared.descriptors.pca_whitening import PcaWhitening, Rows
from shared.errors import Unprocessable
from shared.storage import FolderStore, ObjectStore

BLOCK_BYTES = 64_000_000  # of float64 columns in one block
SAMPLE_BYTES = 1_000_000_000  # maximum size of the sample of rows
MIN_SAMPLE_ROWS = 1000
SAMPLE_PER_DIMENSION = 4
FLOAT32 = np.dtype("<f4")


def sample_size(dimension: int, components: int) -> int:
    """Return the maximum number of rows to fit on, for `components` of `dimension` dimensions.

    SAMPLE_PER_DIMENSION rows per component, as far as SAMPLE_BYTES allow, but always two per
    component: the time of a fit grows with the square of the number of rows.
    """
    target = max(MIN_SAMPLE_ROWS, SAMPLE_PER_DIMENSION * components)
    return min(target, max(2 * components, SAMPLE_BYTES // (FLOAT32.itemsize * dimension)))


def sample_rows(available: int, sample: int, seed: int) -> NDArray[np.int64]:
    """Choose at most `sample` of `available` rows; return their indices, ascending."""
    chosen = np.random.default_rng(seed).choice(
        available, size=min(sample, available), replace=False
    )
    return np.sort(chosen)


def usable_rows(rows: Rows) -> NDArray[np.bool_]:
    """Return the (n,) mask of the (n, D) rows that are finite and not zero."""
    lengths = np.linalg.norm(rows, axis=1)
    return np.asarray(np.isfinite(lengths) & (lengths > 0))


class ColumnSource(Protocol):
    """(count, dimension) float32 rows that are read in blocks of columns."""

    @property
    def count(self) -> int: ...

    @property
    def dimension(self) -> int: ...

    @property
    def width(self) -> int:
        """Number of columns of a block; the last one may be narrower."""

    def read(self, block: int) -> Rows:
        """Return the (count, width) columns of a block, counted from 0."""


def block_count(rows: ColumnSource) -> int:
    """Return the number of blocks of columns."""
    return -(-rows.dimension // rows.width)


def block_width(count: int, dimension: int, block_bytes: int = BLOCK_BYTES) -> int:
    """Return the number of columns in a block of (count, dimension) rows.

    All columns if there are more rows than dimensions: the products of columns are the smaller
    matrix then.
    """
    if count > dimension:
        return dimension
    return min(dimension, max(1, block_bytes // (8 * max(1, count))))


class ArrayColumns:
    """A ColumnSource over an array, which may be memory-mapped."""

    def __init__(self, rows: Rows, block_bytes: int = BLOCK_BYTES) -> None:
        self._rows = rows
        self.count, self.dimension = rows.shape
        self.width = block_width(self.count, self.dimension, block_bytes)

    def read(self, block: int) -> Rows:
        begin = block * self.width
        return self._rows[:, begin : begin + self.width]


class StoredColumns:
    """A ColumnSource in an object store, one object per block of columns and batch of rows.

    Objects `PREFIX<block>-<first row>.f32` are (rows, width) float32, little-endian, C order.
    """

    def __init__(
        self, store: ObjectStore, prefix: str, dimension: int, width: int, count: int = 0
    ) -> None:
        """Open the rows under `prefix`.

        Args:
            dimension: Number of columns.
            width: Number of columns of a block: `block_width` of the maximum number of rows.
            count: Number of rows stored already.
        """
        self._store = store
        self._prefix = prefix
        self.dimension = dimension
        self.width = width
        self.count = count

    def add(self, rows: Rows) -> None:
        """Append (n, dimension) rows.

        Rows that were written before a crash but not counted are overwritten.
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


# Relative to the largest variance. Below, whitening would amplify float32 rounding errors.
MIN_VARIANCE = 1e-9

Matrix = NDArray[np.float64]


class _PcaFitStage(StrEnum):
    """The stages of a fit, in their order."""

    PRODUCTS = "products"  # Gram matrix
    VARIANCES = "variances"  # eigenvalues
    DIRECTIONS = "directions"
    DONE = "done"


@dataclass(frozen=True, slots=True, eq=False)
class PcaBlock:
    """A block of columns of the fitted whitening."""

    mean: Rows
    """(width,)"""
    directions: Rows
    """(components, width), each divided by its standard deviation."""


class PcaFit:
    """Fits a PCA whitening: call `step` until `done`.

    Deterministic: the same rows give the same whitening.
    """

    def __init__(self, rows: ColumnSource, components: int) -> None:
        """Raises Unprocessable as `check_pca_fittable` does."""
        check_pca_fittable(rows.count, rows.dimension, components)
        self._rows = rows
        self._components = components
        self._blocks = block_count(rows)
        self.stage = _PcaFitStage.PRODUCTS
        self._block = 0
        """Blocks of columns done in the current stage."""
        # The smaller one of XX' (rows) and X'X (columns).
        self._by_columns = rows.count > rows.dimension and self._blocks == 1
        size = rows.dimension if self._by_columns else rows.count
        self._products: Matrix = np.zeros((size, size))
        self._basis: Matrix = np.empty((size, 0))
        """Multiplied with a centred block, it gives the block's directions."""
        self._variances: Matrix = np.empty(0)
        self._total = 0.0

    @property
    def done(self) -> bool:
        return self.stage == _PcaFitStage.DONE

    @property
    def progress(self) -> tuple[int, int]:
        """Steps done, and the total."""
        steps_before = {
            _PcaFitStage.PRODUCTS: 0,
            _PcaFitStage.VARIANCES: 0,
            _PcaFitStage.DIRECTIONS: self._blocks + 1,
        }
        total = 2 * self._blocks + 1
        return (total if self.done else steps_before[self.stage] + self._block), total

    @property
    def parts(self) -> int:
        """Number of blocks of the result returned so far."""
        if self.done:
            return self._blocks
        return self._block if self.stage == _PcaFitStage.DIRECTIONS else 0

    def step(self) -> PcaBlock | None:
        """Process one block of columns, or compute the variances.

        Returns:
            In the stage DIRECTIONS a block of the result, else None.

        Raises:
            Unprocessable: `pca_too_many_dimensions` if the rows vary in too few directions.
        """
        if self.stage == _PcaFitStage.VARIANCES:
            self._find_variances()
            return None
        block, mean = _centred(self._rows.read(self._block))
        part = None
        if self.stage == _PcaFitStage.PRODUCTS:
            self._products += block.T @ block if self._by_columns else block @ block.T
        else:
            directions = self._basis.T if self._by_columns else self._basis.T @ block
            part = PcaBlock(mean.astype(np.float32), directions.astype(np.float32))
        self._block += 1
        if self._block == self._blocks:
            if self.stage == _PcaFitStage.DIRECTIONS:
                self.stage = _PcaFitStage.DONE
            else:
                self.stage = _PcaFitStage.VARIANCES
        return part

    def whitening(self, parts: Sequence[PcaBlock]) -> PcaWhitening:
        """Join the blocks of a completed fit, in the order in which `step` returned them."""
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
        squares, vectors = _largest_eigenpairs(self._products, self._components)
        self._variances = squares / freedom
        self._total = float(np.trace(self._products)) / freedom
        # p / sqrt(l) = X'u / s * sqrt(n - 1) / s; by columns the vectors are the directions p.
        scale = 1 / np.sqrt(self._variances) if self._by_columns else np.sqrt(freedom) / squares
        self._basis = vectors * scale
        self._products = np.empty((0, 0))
        self.stage, self._block = _PcaFitStage.DIRECTIONS, 0


def check_pca_fittable(rows: int, dimension: int, components: int) -> None:
    """Check that `rows` rows of `dimension` dimensions can be projected to `components`.

    Raises:
        Unprocessable: `pca_too_many_dimensions` if `components` exceeds `dimension`;
            `pca_too_few_rows` unless there are more than `components` rows.
    """
    if components > dimension:
        raise Unprocessable(
            "pca_too_many_dimensions",
            f"Descriptors of {dimension} dimensions can't be projected to {components}. Use fewer.",
        )
    if rows <= components:
        raise Unprocessable(
            "pca_too_few_rows",
            f"PCA to {components} dimensions needs more than {components} described photos, "
            f"preferably several times as many, but there are {rows}. Index more photos, or use "
            "fewer dimensions.",
        )


def fit_pca(rows: Rows, components: int, *, block_bytes: int = BLOCK_BYTES) -> PcaWhitening:
    """Fit a whitening of (n, D) rows, which may be memory-mapped, to `components` dimensions.

    Raises as `PcaFit` does.
    """
    return fit_pca_columns(ArrayColumns(rows, block_bytes), components)


def fit_pca_columns(
    rows: ColumnSource,
    components: int,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> PcaWhitening:
    """Fit a whitening of rows to `components` dimensions.

    `on_progress` is called with the steps done and the total. Raises as `PcaFit` does.
    """
    fit = PcaFit(rows, components)
    parts = []
    while not fit.done:
        part = fit.step()
        if part is not None:
            parts.append(part)
        on_progress(*fit.progress)
    return fit.whitening(parts)


def _largest_eigenpairs(matrix: Matrix, components: int) -> tuple[Matrix, Matrix]:
    """Return the largest eigenvalues, largest first, and (N, components) unit eigenvectors."""
    values, vectors = np.linalg.eigh(matrix)
    values, vectors = values[::-1][:components], vectors[:, ::-1][:, :components]
    usable = int((values > MIN_VARIANCE * max(values[0], 0)).sum())
    if usable < components:
        raise Unprocessable(
            "pca_too_many_dimensions",
            f"The described photos vary in {usable} directions only, but PCA to {components} "
            f"dimensions needs {components}. Index more varied photos, or use fewer dimensions.",
        )
    return values, vectors


def _centred(block: Rows) -> tuple[Matrix, Matrix]:
    """Return the centred columns and their means, in float64."""
    centred = block.astype(np.float64)
    means: Matrix = centred.mean(axis=0)
    centred -= means
    return centred, means


def _with_fixed_signs(directions: Rows) -> Rows:
    """Flip directions (components, D) so that the element of largest magnitude is positive.

    Eigenvectors have an arbitrary sign; this makes the result deterministic. C order.
    """
    fixed = np.ascontiguousarray(directions)
    for direction in fixed:
        if direction[np.abs(direction).argmax()] < 0:
            # Not np.negative in place: wrong in NumPy 2.4 for rows with a stride of 16 bytes.
            direction *= -1
    return fixed


ROWS_FOLDER_PREFIX = "rows-"


def fit_pca_stream(
    batches: Iterable[Rows],
    max_rows: int,
    dimension: int,
    components: int,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, max_rows: None,
) -> PcaWhitening:
    """Fit a whitening to batches of rows, which are stored in a temporary folder meanwhile.

    Args:
        batches: (n, dimension) rows; rows that are zero or not finite are skipped.
        max_rows: Maximum number of rows in all batches.
        dimension: Number of columns.
        components: Number of dimensions after the projection.
        on_progress: Called with the stage (`gathering`, `reducing`), the rows or steps done and
            the total.

    Raises as `PcaFit` does.
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
            stored, components, lambda done, steps: on_progress("reducing", done, steps)
        )
