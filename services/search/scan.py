"""The dense scan: every row that is asked for is compared exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.search.loaded_chunk import LoadedChunk

# float32 dot products of unit rows err by less than this at 98,304 dimensions (measured 4e-7):
# candidates this close to the k-th are scored again in float64 before they are ranked.
FLOAT32_MARGIN = 1e-5

# Picking rows copies them: worth it up to this share of a chunk, else all are multiplied.
FEW = 0.25

Query = NDArray[np.float32]
Rows = NDArray[np.int64]
Scores = NDArray[np.float64]


def scan(
    chunks: Sequence[LoadedChunk], query: Query, k: int, asked: NDArray[np.bool_]
) -> tuple[Rows, Scores]:
    """The numbers and cosines of all rows that can be among the k most similar, unsorted.

    `query` is (dimension,), of any length but 0; rows are unit vectors or zero. `asked`, (n,), says
    which of the chunks' rows, one chunk after the other, may be answered; one at least. Cosines are
    float64 sums.
    """
    rows, rough = _rough(chunks, query, asked)
    k = min(k, len(rough))
    kth = np.partition(rough, len(rough) - k)[len(rough) - k]
    found = rows[rough >= kth - FLOAT32_MARGIN]
    return found, exact_scores(chunks, query, found)


def scan_at_least(
    chunks: Sequence[LoadedChunk], query: Query, least: float, asked: NDArray[np.bool_]
) -> tuple[Rows, Scores]:
    """The same of all rows whose cosine may be at least that."""
    rows, rough = _rough(chunks, query, asked)
    found = rows[rough >= least - FLOAT32_MARGIN]
    return found, exact_scores(chunks, query, found)


def exact_scores(chunks: Sequence[LoadedChunk], query: Query, rows: Rows) -> Scores:
    """The cosines of these rows."""
    unit = _unit(query)
    firsts = np.cumsum([0, *(len(chunk.rows) for chunk in chunks)])
    of_chunk = np.searchsorted(firsts, rows, side="right") - 1
    places = zip(of_chunk.tolist(), (rows - firsts[of_chunk]).tolist(), strict=True)
    return np.array([chunks[chunk].rows[row].astype(np.float64) @ unit for chunk, row in places])


def _rough(
    chunks: Sequence[LoadedChunk], query: Query, asked: NDArray[np.bool_]
) -> tuple[Rows, NDArray[np.float32]]:
    """The rows that are asked for, and their cosines in float32."""
    unit = _unit(query).astype(np.float32)
    scores: list[NDArray[np.float32]] = []
    numbers: list[Rows] = []
    first = 0
    for chunk in chunks:
        rows = np.flatnonzero(asked[first : first + len(chunk.rows)])
        if len(rows):
            few = len(rows) <= FEW * len(chunk.rows)
            scores.append(chunk.rows[rows] @ unit if few else (chunk.rows @ unit)[rows])
            numbers.append(rows + first)
        first += len(chunk.rows)
    return np.concatenate(numbers), np.concatenate(scores)


def _unit(query: Query) -> Scores:
    exact = query.astype(np.float64)
    return exact / np.linalg.norm(exact)
