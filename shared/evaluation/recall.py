"""Recall@k and ground truth by position, as in the visual place recognition literature.

A database photo within 25 m of a query is a positive: Euclidean distance in UTM metres, 25.00 m
included (as in VPR-datasets-downloader and deep-visual-geo-localization-benchmark).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

POSITIVE_WITHIN_M = 25.0
QUERIES_PER_BLOCK = 256
MAX_CANDIDATES_PER_BLOCK = 2_000_000
"""candidate pairs per block; about 150 MB"""

Positions = NDArray[np.float64]
Descriptors = NDArray[np.float32]
Indices = NDArray[np.int64]


def positives_within(
    queries: Positions, database: Positions, within_m: float = POSITIVE_WITHIN_M
) -> list[Indices]:
    """Find the database photos within a radius of each query.

    A grid of square cells as wide as the radius limits the comparisons to nine cells per query.
    Memory grows with the numbers of photos and positives, not with n times m.

    Args:
        queries: (n, 2) UTM easting and northing in metres.
        database: (m, 2) UTM easting and northing in metres, in the same zone.
        within_m: radius in metres, inclusive.

    Returns:
        For each query the indices of its positives, int64, ascending.
    """
    if not len(queries) or not len(database):
        return [np.empty(0, np.int64) for _ in queries]
    grid = _PositionGrid(database, within_m)
    first, last = grid.candidates(queries)
    counts = (last - first).sum(axis=0)
    positives: list[Indices] = []
    start = 0
    while start < len(queries):
        block = np.searchsorted(np.cumsum(counts[start:]), MAX_CANDIDATES_PER_BLOCK, "right")
        stop = start + max(1, int(block))
        positives += grid.filter(queries[start:stop], first[:, start:stop], last[:, start:stop])
        start = stop
    return positives


class _PositionGrid:
    """Grid index over (m, 2) positions, sorted by cell."""

    def __init__(self, positions: Positions, within_m: float) -> None:
        self.within_m = within_m
        self.origin = positions.min(axis=0)
        extent = float((positions.max(axis=0) - self.origin).max())
        # Slightly wider than the radius, so that rounding cannot put neighbours two cells apart;
        # and wide enough that cell numbers do not overflow.
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
        """Return the (3, n) starts and ends of each query's nine cells in the sorted order.

        The three cells of a column are contiguous.
        """
        cells = self._cell(queries)
        # Queries far outside have no candidates; clipping keeps their cell numbers from overflow.
        columns = np.clip(cells[:, 0], -2, self.columns + 1) + np.array([[-1], [0], [1]])
        low = np.clip(cells[:, 1], 0, self.rows - 1)
        high = np.clip(cells[:, 1] + 2, 0, self.rows - 1)
        first = np.searchsorted(self.keys, columns * self.rows + low, "left")
        last = np.searchsorted(self.keys, columns * self.rows + high, "right")
        return first, np.maximum(first, last)

    def filter(self, queries: Positions, first: Indices, last: Indices) -> list[Indices]:
        """Return the candidates of each query that are within the radius."""
        counts = (last - first).ravel()
        starts = np.cumsum(counts) - counts
        position = np.repeat(first.ravel() - starts, counts) + np.arange(int(counts.sum()))
        query = np.repeat(np.tile(np.arange(len(queries)), 3), counts)
        offset = queries[query] - self.positions[position]
        # Compare squares, as the search trees of published ground truths do: a root would round
        # once more.
        is_positive = offset[:, 0] ** 2 + offset[:, 1] ** 2 <= self.within_m**2
        query, index = query[is_positive], self.order[position[is_positive]]
        by_query = np.lexsort((index, query))
        ends = np.cumsum(np.bincount(query, minlength=len(queries)))
        return np.split(index[by_query], ends[:-1])


def rank_by_similarity(queries: Descriptors, database: Descriptors, k: int) -> Indices:
    """Rank the database by cosine similarity, with the whole database in memory.

    Args:
        queries: (n, D) L2-normalised descriptors.
        database: (m, D) L2-normalised descriptors.

    Returns:
        (n, min(k, m)) int64 database indices, most similar first; ties are ordered by index.
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
    """Compute recall@k: the share of queries with a positive among their first k.

    Args:
        ranked: (queries, depth) database indices, best first.
        positives: database indices of each query's positives. A query without positives counts as
            a miss; filter such queries beforehand to exclude them.

    Returns:
        k -> recall from 0 to 1; NaN without queries.

    Raises:
        ValueError: the numbers of rankings and queries differ.
    """
    if len(ranked) != len(positives):
        raise ValueError(f"{len(ranked)} rankings for {len(positives)} queries")
    hits = np.array(
        [np.isin(row, rows) for row, rows in zip(ranked, positives, strict=True)], dtype=bool
    ).reshape(ranked.shape)
    return {k: float(hits[:, :k].any(axis=1).mean()) if len(hits) else float("nan") for k in ks}
