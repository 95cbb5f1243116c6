"""The dense scan: every row that is asked for is compared exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.search.snapshot import LoadedChunk

# float32 dot products of unit rows err by less than this at 98,304 dimensions (measured 4e-7):
# candidates this close to the k-th are scored again in float64 before they are ranked.
FLOAT32_MARGIN = 1e-5

# Picking rows copies them: worth it up to this share of a chunk, else all are multiplied.
FEW = 0.25


def scan(
    chunks: Sequence[LoadedChunk],
    query: NDArray[np.float32],
    k: int,
    asked: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The numbers and cosines of all rows that can be among the k most similar, unsorted.

    `query` is (dimension,) float32, of any length but 0; rows are unit vectors or zero. `asked`,
    (n,), says which of the chunks' rows, one chunk after the other, may be answered; one at least.
    Cosines are float64 sums.
    """
    exact_query = query.astype(np.float64)
    exact_query /= np.linalg.norm(exact_query)
    rough_query = exact_query.astype(np.float32)
    rough: list[NDArray[np.float32]] = []
    numbers: list[NDArray[np.int64]] = []
    first = 0
    for chunk in chunks:
        rows = np.flatnonzero(asked[first : first + len(chunk.rows)])
        if len(rows):
            few = len(rows) <= FEW * len(chunk.rows)
            rough.append(
                chunk.rows[rows] @ rough_query if few else (chunk.rows @ rough_query)[rows]
            )
            numbers.append(rows + first)
        first += len(chunk.rows)
    near = _near(np.concatenate(rough), k)
    found = np.concatenate(numbers)[near]
    firsts = np.cumsum([0, *(len(chunk.rows) for chunk in chunks)])
    of_chunk = np.searchsorted(firsts, found, side="right") - 1
    places = zip(of_chunk.tolist(), (found - firsts[of_chunk]).tolist(), strict=True)
    scores = np.array(
        [chunks[chunk].rows[row].astype(np.float64) @ exact_query for chunk, row in places]
    )
    return found, scores


def _near(scores: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Indices of all rows that can be among the exact top k."""
    k = min(k, len(scores))
    kth = np.partition(scores, len(scores) - k)[len(scores) - k]
    return np.flatnonzero(scores >= kth - FLOAT32_MARGIN)
