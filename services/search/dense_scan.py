"""Dense scan: exact comparison of a query with every selected row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk

# Upper bound of the error of float32 dot products of unit rows at 98,304 dimensions (measured
# 4e-7): candidates this close to the k-th score are scored again in float64 before ranking.
FLOAT32_MARGIN = 1e-5

# NumPy converts as many float16 numbers in 2 ms, but ten times as slowly as it multiplies. More are
# multiplied by a compiled kernel, whose import takes a second.
NUMPY_FLOAT16_NUMBERS = 1_000_000

# Selecting rows copies them, which pays up to this share of a chunk; beyond, all are multiplied.
GATHER_SHARE = 0.25

QueryRow = NDArray[np.float32]
RowNumbers = NDArray[np.int64]
Scores = NDArray[np.float64]


def scan_top_k(
    chunks: Sequence[LoadedChunk], query: QueryRow, k: int, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, Scores]:
    """Find all rows that can be among the k most similar ones.

    Args:
        chunks: Chunks of n rows in total; rows are unit vectors or zero.
        query: (dimension,) row of any length but 0.
        k: Number of results.
        row_mask: (n,) bool, the rows that may be returned, in the chunks' order; at least one.

    Returns:
        Row numbers and float64 cosines, unsorted; at least `k` rows if as many are selected.
    """
    rows, rough = _float32_scores(chunks, query, row_mask)
    k = min(k, len(rough))
    kth = np.partition(rough, len(rough) - k)[len(rough) - k]
    near_top = rows[rough >= kth - FLOAT32_MARGIN]
    return near_top, exact_scores(chunks, query, near_top)


def scan_min_score(
    chunks: Sequence[LoadedChunk], query: QueryRow, min_score: float, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, Scores]:
    """Find all rows whose cosine may be at least `min_score`; see `scan_top_k`."""
    rows, rough = _float32_scores(chunks, query, row_mask)
    passing = rows[rough >= min_score - FLOAT32_MARGIN]
    return passing, exact_scores(chunks, query, passing)


def exact_scores(chunks: Sequence[LoadedChunk], query: QueryRow, rows: RowNumbers) -> Scores:
    """Return the float64 cosines of the given rows."""
    unit = _normalize(query)
    firsts = np.cumsum([0, *(len(chunk.rows) for chunk in chunks)])
    of_chunk = np.searchsorted(firsts, rows, side="right") - 1
    places = zip(of_chunk.tolist(), (rows - firsts[of_chunk]).tolist(), strict=True)
    return np.array([chunks[chunk].rows[row].astype(np.float64) @ unit for chunk, row in places])


def _float32_scores(
    chunks: Sequence[LoadedChunk], query: QueryRow, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, NDArray[Any]]:
    """Return the selected row numbers, and their cosines, whose error is that of float32."""
    unit = _normalize(query).astype(np.float32)
    use_kernel = int(np.count_nonzero(row_mask)) * len(unit) > NUMPY_FLOAT16_NUMBERS
    scores: list[NDArray[Any]] = []
    numbers: list[RowNumbers] = []
    first = 0
    for chunk in chunks:
        rows = np.flatnonzero(row_mask[first : first + len(chunk.rows)])
        if len(rows):
            scores.append(_multiply(chunk, rows, unit, use_kernel))
            numbers.append(rows + first)
        first += len(chunk.rows)
    return np.concatenate(numbers), np.concatenate(scores)


def _multiply(
    chunk: LoadedChunk, rows: RowNumbers, unit: QueryRow, use_kernel: bool
) -> NDArray[Any]:
    """Return the products of the given rows of a chunk with the query, float32 or float64."""
    if chunk.rows.dtype == np.float16:
        return _kernel_products(chunk, rows, unit) if use_kernel else chunk.rows[rows] @ unit
    gather = len(rows) <= GATHER_SHARE * len(chunk.rows)
    return chunk.rows[rows] @ unit if gather else (chunk.rows @ unit)[rows]


def _kernel_products(chunk: LoadedChunk, rows: RowNumbers, unit: QueryRow) -> Scores:
    from services.search.exact_rerank import RowBlocks  # importing numba is slow

    products = np.empty(len(rows))
    RowBlocks.of([chunk]).multiply(rows, unit, products)
    return products


def compile_kernel(chunks: Sequence[LoadedChunk]) -> None:
    """Compile what scans of these chunks use, so that no query waits for it."""
    float16 = [chunk for chunk in chunks if chunk.rows.dtype == np.float16]
    if sum(chunk.rows.size for chunk in float16) > NUMPY_FLOAT16_NUMBERS:
        unit = np.ones(float16[0].rows.shape[1], np.float32)
        _kernel_products(float16[0], np.zeros(1, np.int64), unit)


def _normalize(query: QueryRow) -> Scores:
    exact = query.astype(np.float64)
    return exact / np.linalg.norm(exact)
