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

UnitQuery = NDArray[np.float64]


class Scan:
    """The selected rows of some chunks, numbered through, with their float32 scores."""

    def __init__(
        self,
        chunks: Iterable[LoadedChunk],
        query: UnitQuery,
        wanted: PhotoFilter,
        exclude: frozenset[UUID],
    ) -> None:
        rough_query = query.astype(np.float32)
        rough: list[NDArray[np.float32]] = []
        self._at: list[tuple[LoadedChunk, NDArray[np.intp]]] = []
        for chunk in chunks:
            rows = np.flatnonzero(select(chunk.photos, wanted, exclude))
            if not len(rows):
                continue
            few = len(rows) <= FEW * len(chunk.rows)
            rough.append(
                chunk.rows[rows] @ rough_query if few else (chunk.rows @ rough_query)[rows]
            )
            self._at.append((chunk, rows))
        self.scores = np.concatenate(rough) if rough else np.empty(0, np.float32)
        """(n,) cosines, right to FLOAT32_MARGIN."""
        self._firsts = np.cumsum([0, *(len(rows) for _, rows in self._at)])

    def exact(self, number: int, query: UnitQuery) -> float:
        """The cosine as a float64 sum, clipped: rounding may not turn it into 1.0000001."""
        chunk, row = self._row(number)
        return float(np.clip(chunk.rows[row].astype(np.float64) @ query, -1.0, 1.0))

    def photo_id(self, number: int) -> UUID:
        chunk, row = self._row(number)
        photo_id: UUID = chunk.photos.photo_id[row]
        return photo_id

    def _row(self, number: int) -> tuple[LoadedChunk, int]:
        which = int(np.searchsorted(self._firsts, number, side="right")) - 1
        chunk, rows = self._at[which]
        return chunk, int(rows[number - int(self._firsts[which])])


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
    query is divided by its norm. Order: score, highest first; equal scores by photo id.
    """
    exact_query = unit(query)
    if exact_query is None:
        return [], 0, 0
    scan = Scan(chunks, exact_query, wanted, exclude)
    ranked = [
        (scan.exact(number, exact_query), scan.photo_id(number))
        for number in candidates(scan.scores, k).tolist()
    ]
    ranked.sort(key=lambda hit: (-hit[0], hit[1]))
    hits = [
        (photo_id, score) for score, photo_id in ranked if min_score is None or score >= min_score
    ]
    return hits[:k], len(scan.scores), len(ranked)


def unit(query: NDArray[np.float32]) -> UnitQuery | None:
    """The query divided by its norm; None for one of length 0, which is like nothing."""
    norm = float(np.linalg.norm(query.astype(np.float64)))
    return None if norm == 0.0 else query.astype(np.float64) / norm


def candidates(scores: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Indices of all rows that can be among the exact top k."""
    k = min(k, len(scores))
    if not k:
        return np.empty(0, np.int64)
    kth = np.partition(scores, len(scores) - k)[len(scores) - k]
    return np.flatnonzero(scores >= kth - FLOAT32_MARGIN)
