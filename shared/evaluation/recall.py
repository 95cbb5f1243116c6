"""recall@k by position, as visual place recognition measures it.

A database photo within 25 m of a query is a true positive of it: straight-line distance in UTM
metres, 25.00 m included. (VPR-datasets-downloader, deep-visual-geo-localization-benchmark)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

POSITIVE_WITHIN_M = 25.0
QUERIES_PER_BLOCK = 256
MAX_CANDIDATES_PER_BLOCK = 2_000_000
"""pairs that are measured at a time: about 150 MB"""

Positions = NDArray[np.float64]
Descriptors = NDArray[np.float32]
Indices = NDArray[np.int64]


def positives_within(
    queries: Positions, database: Positions, within_m: float = POSITIVE_WITHIN_M
) -> list[Indices]:
    """(n, 2) and (m, 2) UTM metres of one zone -> for each query its positives, ascending.

    The database is sorted into square cells as wide as the radius, so that a query looks at nine of
    them: memory grows with the photos and the positives, not with n times m.
    """
    if not len(queries) or not len(database):
        return [np.empty(0, np.int64) for _ in queries]
    cells = _PositionGrid(database, within_m)
    first, last = cells.candidates(queries)
    counts = (last - first).sum(axis=0)
    found: list[Indices] = []
    start = 0
    while start < len(queries):
        taken = np.searchsorted(np.cumsum(counts[start:]), MAX_CANDIDATES_PER_BLOCK, "right")
        stop = start + max(1, int(taken))
        found += cells.near(queries[start:stop], first[:, start:stop], last[:, start:stop])
        start = stop
    return found


class _PositionGrid:
    """(m, 2) positions, sorted by the square cell that they lie in."""

    def __init__(self, positions: Positions, within_m: float) -> None:
        self.within_m = within_m
        self.origin = positions.min(axis=0)
        extent = float((positions.max(axis=0) - self.origin).max())
        # A hair wider than the radius, lest rounding puts two neighbours two cells apart; and not
        # so small that a cell's number overflows.
        self.width = max(within_m * 1.000001, extent / 2**30, 1e-3)
        cells = self._cell(positions)
        self.columns = int(cells[:, 0].max()) + 1
        self.rows = int(cells[:, 1].max()) + 3
        keys = cells[:, 0] * self.rows + cells[:, 1] + 1
        self.order = np.argsort(keys, kind="stable")
        self.keys = keys[self.order]
        self.positions = positions[self.order]

    def _cell(self, positions: Positions) -> Indices:
        cells: Indices = np.floor((positions - self.origin) / self.width).astype(np.int64)
        return cells

    def candidates(self, queries: Positions) -> tuple[Indices, Indices]:
        """(3, n) from where to before where a query's nine cells lie in the sorted order: the three
        of one column follow each other."""
        cells = self._cell(queries)
        # What is far outside has no neighbour, and its number must not overflow either.
        columns = np.clip(cells[:, 0], -2, self.columns + 1) + np.array([[-1], [0], [1]])
        low = np.clip(cells[:, 1], 0, self.rows - 1)
        high = np.clip(cells[:, 1] + 2, 0, self.rows - 1)
        first = np.searchsorted(self.keys, columns * self.rows + low, "left")
        last = np.searchsorted(self.keys, columns * self.rows + high, "right")
        return first, np.maximum(first, last)

    def near(self, queries: Positions, first: Indices, last: Indices) -> list[Indices]:
        counts = (last - first).ravel()
        starts = np.cumsum(counts) - counts
        place = np.repeat(first.ravel() - starts, counts) + np.arange(int(counts.sum()))
        query = np.repeat(np.tile(np.arange(len(queries)), 3), counts)
        away = queries[query] - self.positions[place]
        # Squares, as the trees of published ground truths compare: a root would round once more.
        near = away[:, 0] ** 2 + away[:, 1] ** 2 <= self.within_m**2
        query, number = query[near], self.order[place[near]]
        ordered = np.lexsort((number, query))
        ends = np.cumsum(np.bincount(query, minlength=len(queries)))
        return np.split(number[ordered], ends[:-1])


def rank_by_similarity(queries: Descriptors, database: Descriptors, k: int) -> Indices:
    """(n, D) and (m, D) unit rows -> (n, min(k, m)) database indices, most similar first.

    Of equally similar ones the lower index comes first, so that a tie is nobody's luck.
    """
    ranked = []
    for start in range(0, len(queries), QUERIES_PER_BLOCK):
        scores = queries[start : start + QUERIES_PER_BLOCK] @ database.T
        ranked.append(np.argsort(-scores, axis=1, kind="stable")[:, :k])
    if not ranked:
        return np.empty((0, min(k, len(database))), np.int64)
    return np.concatenate(ranked)


def recall_at_k(
    ranked: Indices, positives: Sequence[Indices], ks: Sequence[int] = (1, 5, 10)
) -> dict[int, float]:
    """The share of queries, 0 to 1, that have a positive among their first k, for each k.

    A query without any positive counts as missed: leave it out before, if it is not meant.
    NaN where there is no query at all.
    """
    if len(ranked) != len(positives):
        raise ValueError(f"{len(ranked)} rankings for {len(positives)} queries")
    hits = np.array(
        [np.isin(row, found) for row, found in zip(ranked, positives, strict=True)], dtype=bool
    ).reshape(ranked.shape)
    return {k: float(hits[:, :k].any(axis=1).mean()) if len(hits) else float("nan") for k in ks}
