"""The truth: every row multiplied with every query in float64."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.chunks import Rows

BLOCK_ROWS = 128  # rows that are brought to float64: 100 MB at 98,304 dimensions
DECIMALS = 12  # scores that agree to so many are equal, and the photos' ids decide
TOLERANCE = 1e-9  # of a score: float64 sums of 98,304 products differ by less than 1e-14

Ranking = Sequence[tuple[UUID, float]]
"""Photos with their cosines, best first."""


@dataclass(frozen=True, slots=True, eq=False)
class BruteForce:
    """The cosines of n photos with q queries."""

    photo_ids: Sequence[UUID]
    scores: NDArray[np.float64]
    """(q, n)"""

    @classmethod
    def of(cls, pieces: Iterable[Rows], photo_ids: Sequence[UUID], queries: Rows) -> BruteForce:
        """`pieces` are the rows of the photos, in their order; rows have length 1."""
        asked = queries.astype(np.float64)
        asked /= np.linalg.norm(asked, axis=1, keepdims=True)
        scores = np.empty((len(queries), len(photo_ids)))
        done = 0
        for rows in pieces:
            for begin in range(0, len(rows), BLOCK_ROWS):
                part = rows[begin : begin + BLOCK_ROWS].astype(np.float64)
                scores[:, done : done + len(part)] = asked @ part.T
                done += len(part)
        if done != len(photo_ids):
            raise ValueError(f"{done} rows of {len(photo_ids)} photos")
        return cls(photo_ids, np.round(scores, DECIMALS))

    def best(
        self,
        query: int,
        k: int,
        min_score: float | None = None,
        live: NDArray[np.bool_] | None = None,
    ) -> Ranking:
        """The answer to query number `query`, among the photos that are `live`, (n,)."""
        scores = self.scores[query]
        may = np.ones(len(scores), bool) if live is None else live.copy()
        if min_score is not None:
            may &= scores >= min_score
        left = np.flatnonzero(may)
        if len(left) > k:
            kth = np.partition(scores[left], len(left) - k)[len(left) - k]
            left = left[scores[left] >= kth]
        found = sorted((-float(scores[row]), self.photo_ids[row]) for row in left.tolist())
        return [(photo_id, -score) for score, photo_id in found[:k]]


def same_ranking(found: Ranking, expected: Ranking) -> bool:
    """Whether the photos are the same in the same order, with the same scores."""
    return len(found) == len(expected) and all(
        ours[0] == truth[0] and abs(ours[1] - truth[1]) <= TOLERANCE
        for ours, truth in zip(found, expected, strict=True)
    )


def same_photos(found: Ranking, expected: Ranking) -> bool:
    """The same for who computes scores in float32."""
    return [photo_id for photo_id, _ in found] == [photo_id for photo_id, _ in expected]
