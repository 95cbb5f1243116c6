"""Exact cosine top-k over the selected rows of a snapshot."""

from __future__ import annotations

from collections.abc import Iterable
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.select import select
from services.search.snapshot import LoadedChunk
from shared.photo_filter import EVERYTHING, PhotoFilter

# float32 dot products of unit rows err by less than this at 98,304 dimensions (measured 4e-7):
# candidates this close to the k-th are scored again in float64 before they are ranked.
FLOAT32_MARGIN = 1e-5

# Picking rows copies them: worth it up to this share of a chunk, else all are multiplied.
FEW = 0.25


def top_k(
    chunks: Iterable[LoadedChunk],
    query: NDArray[np.float32],
    k: int,
    *,
    min_score: float | None = None,
    wanted: PhotoFilter = EVERYTHING,
    exclude: frozenset[UUID] = frozenset(),
) -> tuple[list[tuple[UUID, float]], int, int]:
    """The k most similar photos that pass the filter as (photo, cosine), the rows scanned, the
    rows scored again.

    `query` is (dimension,) float32 and need not be normalised: rows are unit vectors, and the
    query is divided by its norm. Order: score, highest first; equal scores by photo id. Scores
    are float64 sums, clipped to [-1, 1]: rounding may not turn a cosine into 1.0000001.
    """
    norm = float(np.linalg.norm(query.astype(np.float64)))
    if norm == 0.0:
        return [], 0, 0
    exact_query = query.astype(np.float64) / norm
    rough_query = exact_query.astype(np.float32)
    scanned = 0
    rough: list[NDArray[np.float32]] = []
    at: list[tuple[LoadedChunk, NDArray[np.intp]]] = []
    for chunk in chunks:
        rows = np.flatnonzero(select(chunk.photos, wanted, exclude))
        if not len(rows):
            continue
        scanned += len(rows)
        few = len(rows) <= FEW * len(chunk.rows)
        rough.append(chunk.rows[rows] @ rough_query if few else (chunk.rows @ rough_query)[rows])
        at.append((chunk, rows))
    if not scanned:
        return [], 0, 0
    candidates = _candidates(np.concatenate(rough), k)
    firsts = np.cumsum([0, *(len(rows) for _, rows in at)])
    ranked = []
    for index in candidates.tolist():
        which = int(np.searchsorted(firsts, index, side="right")) - 1
        chunk, rows = at[which]
        row = int(rows[index - int(firsts[which])])
        score = float(np.clip(chunk.rows[row].astype(np.float64) @ exact_query, -1.0, 1.0))
        ranked.append((score, chunk.photos.photo_id[row]))
    ranked.sort(key=lambda hit: (-hit[0], hit[1]))
    hits = [
        (photo_id, score) for score, photo_id in ranked if min_score is None or score >= min_score
    ]
    return hits[:k], scanned, len(ranked)


def _candidates(scores: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Indices of all rows that can be among the exact top k."""
    k = min(k, len(scores))
    kth = np.partition(scores, len(scores) - k)[len(scores) - k]
    return np.flatnonzero(scores >= kth - FLOAT32_MARGIN)
