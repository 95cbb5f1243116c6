"""Dense scan: comparison of a query with every selected row.

Products in float32 rule out the rows that cannot be in the result, whatever the rounding of their
sums; the others are compared in float64. The rows are read as they are stored, by a compiled kernel
on all CPUs: BLAS and faiss multiply float32 only. A copy for them takes twice the memory of float16
rows, and twice the bytes have to be read.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from services.search.snapshot import Snapshot
from shared.storage.chunks import NORM_TOLERANCE

# NumPy converts as many float16 numbers in 2 ms. It is used up to this size of a snapshot, because
# importing and compiling the kernel takes a second.
NUMPY_NUMBERS = 1_000_000

ROUNDING = 2.0**-24  # relative error of a float32 operation

QueryRow = NDArray[np.float32]
RowNumbers = NDArray[np.int64]
Scores = NDArray[np.float64]


def scan_top_k(
    snapshot: Snapshot, query: QueryRow, k: int, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, Scores]:
    """Find all rows that can be among the k most similar ones.

    Args:
        snapshot: Snapshot of n rows; rows are unit vectors or zero.
        query: (dimension,) row of any length but 0.
        k: Number of results.
        row_mask: (n,) bool, the rows that may be returned; at least one.

    Returns:
        Row numbers and float64 cosines, unsorted; at least `k` rows if as many are selected.
    """
    rows, scores = _float32_scores(snapshot, query, row_mask)
    k = min(k, len(scores))
    kth = np.partition(scores, len(scores) - k)[len(scores) - k]
    # The k-th row may have lost as much as another row has gained.
    return _rescore(snapshot, query, rows, scores, kth - float32_error(len(query)))


def exact_scores(snapshot: Snapshot, query: QueryRow, rows: RowNumbers) -> Scores:
    """Return the float64 cosines of the given rows; those of equal rows are equal."""
    products: Scores = _multiply(snapshot, rows, query, np.float64)
    return products / vector_length(query)


def float32_error(dimension: int) -> float:
    """Return the largest error of a float32 cosine, whatever the order of its sum.

    N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.1: the error of
    a product of n numbers is at most n u / (1 - n u) times the lengths of the two vectors. One more
    rounding is that of the query's numbers. Rows are as long as `rows_are_valid` permits.
    """
    roundings = (dimension + 1) * ROUNDING
    return (1 + NORM_TOLERANCE) * roundings / (1 - roundings)


def compile_kernel(snapshot: Snapshot) -> None:
    """Compile what scans of the snapshot use, so that no query waits for it."""
    if _uses_kernel(snapshot):
        query, row = np.ones(snapshot.dimension, np.float32), np.zeros(1, np.int64)
        for kind in (np.float32, np.float64):
            _multiply(snapshot, row, query, kind)


def _rescore(
    snapshot: Snapshot, query: QueryRow, rows: RowNumbers, scores: NDArray[Any], min_score: float
) -> tuple[RowNumbers, Scores]:
    """Return the rows whose cosine may be at least `min_score`, and their float64 cosines."""
    # Answers have no score beyond -1 and 1, which a float16 row may exceed: such rows are equal.
    near = rows[np.maximum(scores, -1.0) >= min(min_score, 1.0) - float32_error(len(query))]
    return near, exact_scores(snapshot, query, near)


def _float32_scores(
    snapshot: Snapshot, query: QueryRow, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, NDArray[Any]]:
    """Return the selected row numbers, and their cosines summed in float32."""
    unit = (query / vector_length(query)).astype(np.float32)
    rows = np.flatnonzero(row_mask)
    return rows, _multiply(snapshot, rows, unit, np.float32)


def _multiply(
    snapshot: Snapshot, rows: RowNumbers, query: QueryRow, kind: DTypeLike
) -> NDArray[Any]:
    """Return the products of the given rows with the query, summed in this type."""
    products = np.empty(len(rows), kind)
    if _uses_kernel(snapshot):
        snapshot.row_blocks.multiply(rows, query, products)
        return products
    firsts = snapshot.photos.first_rows
    of_chunk = np.searchsorted(firsts, rows, side="right") - 1
    for chunk in np.unique(of_chunk).tolist():
        here = of_chunk == chunk
        stored = snapshot.chunks[chunk].rows[rows[here] - firsts[chunk]]
        products[here] = np.vecdot(stored.astype(kind), query.astype(kind))
    return products


def vector_length(query: QueryRow) -> np.float64:
    """Return the length of a (dimension,) row, summed in float64."""
    # Not a product by BLAS, whose threads take longer to wake up than this takes.
    return np.float64(np.sqrt(np.square(query, dtype=np.float64).sum()))


def _uses_kernel(snapshot: Snapshot) -> bool:
    return len(snapshot.photos) * snapshot.dimension > NUMPY_NUMBERS
