"""The dense scan: every row that is asked for is compared exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk

# float32 dot products of unit rows err by less than this at 98,304 dimensions (measured 4e-7):
# candidates this close to the k-th are scored again in float64 before they are ranked.
FLOAT32_MARGIN = 1e-5

# Picking rows copies them: worth it up to this share of a chunk, else all are multiplied.
GATHER_SHARE = 0.25

QueryRow = NDArray[np.float32]
RowNumbers = NDArray[np.int64]
Scores = NDArray[np.float64]


def scan_top_k(
    chunks: Sequence[LoadedChunk], query: QueryRow, k: int, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, Scores]:
    """The numbers and cosines of all rows that can be among the k most similar, unsorted.

    `query` is (dimension,), of any length but 0; rows are unit vectors or zero. `row_mask`,
    (n,), says
    which of the chunks' rows, one chunk after the other, may be answered; one at least. Cosines are
    float64 sums.
    """
    rows, rough = _float32_scores(chunks, query, row_mask)
    k = min(k, len(rough))
    kth = np.partition(rough, len(rough) - k)[len(rough) - k]
    found = rows[rough >= kth - FLOAT32_MARGIN]
    return found, exact_scores(chunks, query, found)


def scan_min_score(
    chunks: Sequence[LoadedChunk], query: QueryRow, min_score: float, row_mask: NDArray[np.bool_]
) -> tuple[RowNumbers, Scores]:
    """The same of all rows whose cosine may be at least that."""
    rows, rough = _float32_scores(chunks, query, row_mask)
    found = rows[rough >= min_score - FLOAT32_MARGIN]
    return found, exact_scores(chunks, query, found)


def exact_scores(chunks: Sequence[LoadedChunk], query: QueryRow, rows: RowNumbers) -> Scores:
    """The cosines of these rows."""
    unit = _normalize(query)
    firsts = np.cumsum([0, *(len(chunk.rows) for chunk in chunks)])
    of_chunk = np.searchsorted(firsts, rows, side="right") - 1
    places = zip(of_chunk.tolist(), (rows - firsts[of_chunk]).tolist(), strict=True)
    return np.array([chunks[chunk].rows[row].astype(np.float64) @ unit for chunk, row in places])


def _float32_scores(
    chunks: Sequence[LoadedChunk], query: QueryRow, asked: NDArray[np.bool_]
) -> tuple[RowNumbers, NDArray[np.float32]]:
    """The rows that are asked for, and their cosines in float32."""
    unit = _normalize(query).astype(np.float32)
    scores: list[NDArray[np.float32]] = []
    numbers: list[RowNumbers] = []
    first = 0
    for chunk in chunks:
        rows = np.flatnonzero(asked[first : first + len(chunk.rows)])
        if len(rows):
            few = len(rows) <= GATHER_SHARE * len(chunk.rows)
            scores.append(chunk.rows[rows] @ unit if few else (chunk.rows @ unit)[rows])
            numbers.append(rows + first)
        first += len(chunk.rows)
    return np.concatenate(numbers), np.concatenate(scores)


def _normalize(query: QueryRow) -> Scores:
    exact = query.astype(np.float64)
    return exact / np.linalg.norm(exact)
