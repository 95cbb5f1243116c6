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
FLOAT64_MARGIN = 1e-12  # scores are rounded to as much, and equal ones ordered by photo

# NumPy converts as many float16 numbers in 2 ms, but ten times as slowly as it multiplies. More are
# multiplied in float64 by a compiled kernel, whose import takes a second.
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
    rows, scores, margin = _score_rows(chunks, query, row_mask)
    k = min(k, len(scores))
    kth = np.partition(scores, len(scores) - k)[len(scores) - k]
    return _select(chunks, query, rows, scores, kth, margin)


def _select(
    chunks: Sequence[LoadedChunk],
    query: QueryRow,
    rows: RowNumbers,
    scores: NDArray[Any],
    min_score: float,
    margin: float,
) -> tuple[RowNumbers, Scores]:
    """Return the rows whose score may be at least `min_score`, and their float64 cosines."""
    # Answers have no score above 1, which a float16 row may exceed: such rows are equal.
    near = scores >= min(min_score, 1.0) - margin
    if margin == FLOAT64_MARGIN:
        return rows[near], scores[near]
    return rows[near], exact_scores(chunks, query, rows[near])


def exact_scores(chunks: Sequence[LoadedChunk], query: QueryRow, rows: RowNumbers) -> Scores:
    """Return the float64 cosines of the given rows."""
    unit = _normalize(query)
    firsts = np.cumsum([0, *(len(chunk.rows) for chunk in chunks)])
    of_chunk = np.searchsorted(firsts, rows, side="right") - 1
    places = zip(of_chunk.tolist(), (rows - firsts[of_chunk]).tolist(), strict=True)
    return np.array([chunks[chunk].rows[row].astype(np.float64) @ unit for chunk, row in places])


def _score_rows(
    chunks: Sequence[LoadedChunk], query: QueryRow, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, NDArray[Any], float]:
    """Return the selected row numbers, their cosines, and the margin of equal ones."""
    selected = np.flatnonzero(row_mask)
    has_float16 = any(chunk.rows.dtype == np.float16 for chunk in chunks)
    if has_float16 and len(selected) * len(query) > NUMPY_FLOAT16_NUMBERS:
        return selected, _kernel_cosines(chunks, query, selected), FLOAT64_MARGIN
    unit = _normalize(query).astype(np.float32)
    scores: list[NDArray[Any]] = []
    first = 0
    for chunk in chunks:
        rows = np.flatnonzero(row_mask[first : first + len(chunk.rows)])
        if len(rows):
            gather = has_float16 or len(rows) <= GATHER_SHARE * len(chunk.rows)
            scores.append(chunk.rows[rows] @ unit if gather else (chunk.rows @ unit)[rows])
        first += len(chunk.rows)
    return selected, np.concatenate(scores), FLOAT32_MARGIN


def _kernel_cosines(chunks: Sequence[LoadedChunk], query: QueryRow, rows: RowNumbers) -> Scores:
    from services.search.exact_rerank import RowBlocks  # importing numba is slow

    products = np.empty(len(rows))
    RowBlocks.of(chunks).multiply(rows, query, products)
    return products / np.linalg.norm(query.astype(np.float64))


def compile_kernel(chunks: Sequence[LoadedChunk]) -> None:
    """Compile what scans of these chunks use, so that no query waits for it."""
    float16 = [chunk for chunk in chunks if chunk.rows.dtype == np.float16]
    if sum(chunk.rows.size for chunk in float16) > NUMPY_FLOAT16_NUMBERS:
        query = np.ones(float16[0].rows.shape[1], np.float32)
        _kernel_cosines(float16, query, np.zeros(1, np.int64))


def _normalize(query: QueryRow) -> Scores:
    exact = query.astype(np.float64)
    return exact / np.linalg.norm(exact)
