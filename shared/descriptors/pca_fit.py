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
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from shared.descriptors.pca_whitening import PcaWhitening, Rows
from shared.errors import Unprocessable

BLOCK_BYTES = 64_000_000  # of float64 columns in one block
SAMPLE_BYTES = 1_000_000_000  # maximum size of the sample of rows
MIN_SAMPLE_ROWS = 1000
SAMPLE_PER_DIMENSION = 4


def sample_size(dimension: int, components: int) -> int:
    """Return the maximum number of rows to fit on, for `components` of `dimension` dimensions.

    SAMPLE_PER_DIMENSION rows per component, as far as SAMPLE_BYTES allow, but always two per
    component: the time of a fit grows with the square of the number of rows.
    """
    target = max(MIN_SAMPLE_ROWS, SAMPLE_PER_DIMENSION * components)
    return min(target, max(2 * components, SAMPLE_BYTES // (4 * dimension)))


def sample_rows(available: int, sample: int, seed: int) -> NDArray[np.int64]:
    """Choose at most `sample` of `available` rows; return their indices, ascending."""
    chosen = np.random.default_rng(seed).choice(
        available, size=min(sample, available), replace=False
    )
    return np.sort(chosen)


# Relative to the largest variance. Below, whitening would amplify float32 rounding errors.
MIN_VARIANCE = 1e-9

Matrix = NDArray[np.float64]


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


def fit_pca(
    rows: Rows,
    components: int,
    *,
    block_bytes: int = BLOCK_BYTES,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> PcaWhitening:
    """Fit a whitening of rows to `components` dimensions.

    Deterministic: the same rows give the same whitening.

    Args:
        rows: (n, D) float32, which may be memory-mapped.
        block_bytes: Size of a block of columns in float64.
        on_progress: Called with the blocks done and the total.

    Raises:
        Unprocessable: As `check_pca_fittable`; `pca_too_many_dimensions` also if the rows vary in
            too few directions.
    """
    count, dimension = rows.shape
    check_pca_fittable(count, dimension, components)
    # The products of columns are the smaller matrix if there are more rows than dimensions.
    by_columns = count > dimension
    width = dimension if by_columns else min(dimension, max(1, block_bytes // (8 * count)))
    begins = range(0, dimension, width)
    steps = 2 * len(begins) + 1
    products: Matrix = np.zeros((min(count, dimension),) * 2)
    for done, begin in enumerate(begins, start=1):
        block, _ = _centred(rows[:, begin : begin + width])
        products += block.T @ block if by_columns else block @ block.T
        on_progress(done, steps)
    squares, vectors = _largest_eigenpairs(products, components)
    variances = squares / (count - 1)
    # p / sqrt(l) = X'u / s * sqrt(n - 1) / s; by columns the vectors are the directions p.
    scale = 1 / np.sqrt(variances) if by_columns else np.sqrt(count - 1) / squares
    basis = vectors * scale
    on_progress(len(begins) + 1, steps)
    mean = np.empty(dimension, np.float32)
    directions = np.empty((components, dimension), np.float32)
    for done, begin in enumerate(begins, start=len(begins) + 2):
        columns = slice(begin, begin + width)
        block, mean[columns] = _centred(rows[:, columns])
        directions[:, columns] = basis.T if by_columns else basis.T @ block
        on_progress(done, steps)
    return PcaWhitening(
        mean=mean,
        directions=_with_fixed_signs(directions),
        variances=variances.astype(np.float32),
        explained=float(squares.sum() / np.trace(products)),
        rows=count,
    )


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


def fit_pca_stream(
    batches: Iterable[Rows],
    max_rows: int,
    dimension: int,
    components: int,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, max_rows: None,
) -> PcaWhitening:
    """Fit a whitening to batches of rows, which are stored in a temporary file meanwhile.

    Args:
        batches: (n, dimension) rows; rows that are zero or not finite are skipped.
        max_rows: Maximum number of rows in all batches.
        dimension: Number of columns.
        components: Number of dimensions after the projection.
        on_progress: Called with the stage (`gather`, `reduce`), the rows or steps done and
            the total.

    Raises as `fit_pca` does.
    """
    with tempfile.TemporaryFile(prefix="placewise-pca-") as file:
        seen = kept = 0
        for batch in batches:
            lengths = np.linalg.norm(batch, axis=1)
            rows = batch[np.isfinite(lengths) & (lengths > 0)]
            file.write(np.ascontiguousarray(rows, np.float32).tobytes())
            kept += len(rows)
            seen += len(batch)
            on_progress("gather", seen, max_rows)
        file.flush()
        check_pca_fittable(kept, dimension, components)
        stored = np.memmap(file, np.float32, "r", shape=(kept, dimension))
        return fit_pca(
            stored,
            components,
            on_progress=lambda done, steps: on_progress("reduce", done, steps),
        )
