"""Ground truth of a search: cosines by brute force in float64."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.storage.chunks import Rows

BLOCK_ROWS = 128  # rows converted to float64 at a time: 100 MB at 98,304 dimensions
DECIMALS = 12  # scores equal to this precision are ties, which are ordered by photo id
TOLERANCE = 1e-9  # of a score; float64 sums of 98,304 products differ by less than 1e-14

Ranking = Sequence[tuple[UUID, float]]
"""Photos with their cosines, best first."""


@dataclass(frozen=True, slots=True, eq=False)
class BruteForce:
    """Cosines of n photos with q queries, in float64."""

    photo_ids: Sequence[UUID]
    scores: NDArray[np.float64]
    """(q, n)"""

    @classmethod
    def of(cls, pieces: Iterable[Rows], photo_ids: Sequence[UUID], queries: Rows) -> BruteForce:
        """Compute the cosines; `pieces` are the photos' L2-normalised rows, in order."""
        unit_queries = queries.astype(np.float64)
        unit_queries /= np.linalg.norm(unit_queries, axis=1, keepdims=True)
        scores = np.empty((len(queries), len(photo_ids)))
        done = 0
        for rows in pieces:
            for start in range(0, len(rows), BLOCK_ROWS):
                block = rows[start : start + BLOCK_ROWS].astype(np.float64)
                scores[:, done : done + len(block)] = unit_queries @ block.T
                done += len(block)
        if done != len(photo_ids):
            raise ValueError(f"{done} rows of {len(photo_ids)} photos")
        return cls(photo_ids, np.round(scores, DECIMALS))

    def best(self, query: int, k: int, min_score: float | None = None) -> Ranking:
        """Return the result of query number `query`."""
        scores = self.scores[query]
        candidates = np.flatnonzero(scores >= (-np.inf if min_score is None else min_score))
        if len(candidates) > k:
            kth = np.partition(scores[candidates], len(candidates) - k)[len(candidates) - k]
            candidates = candidates[scores[candidates] >= kth]
        ranked = sorted((-float(scores[row]), self.photo_ids[row]) for row in candidates.tolist())
        return [(photo_id, -score) for score, photo_id in ranked[:k]]


def same_ranking(found: Ranking, expected: Ranking, tolerance: float = TOLERANCE) -> bool:
    """Return whether photos and order are equal and scores differ by at most `tolerance`."""
    return len(found) == len(expected) and all(
        ours[0] == truth[0] and abs(ours[1] - truth[1]) <= tolerance
        for ours, truth in zip(found, expected, strict=True)
    )
