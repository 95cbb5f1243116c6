"""Recall@k and ground truth by position, as in the visual place recognition literature.

A database photo within 25 m of a query is a positive: Euclidean distance in UTM metres, 25.00 m
included (as in VPR-datasets-downloader and deep-visual-geo-localization-benchmark).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

POSITIVE_WITHIN_M = 25.0

Positions = NDArray[np.float64]
Indices = NDArray[np.int64]
Hits = NDArray[np.bool_]


def positives_within(
    queries: Positions, database: Positions, within_m: float = POSITIVE_WITHIN_M
) -> list[Indices]:
    """Return the ascending int64 indices of the database photos within a radius of each query.

    `queries` are (n, 2) and `database` (m, 2) UTM metres of one zone; the radius is inclusive.
    Memory grows with the numbers of photos and positives, not with n times m.
    """
    if not len(database):
        return [np.empty(0, np.int64) for _ in queries]
    from scipy.spatial import cKDTree  # not a package of `make run`, with which cities are drawn

    # The tree compares squares, as those of published ground truths do: a root would round.
    found = cKDTree(database).query_ball_point(queries, within_m, return_sorted=True)
    return [np.array(rows, np.int64) for rows in found]


def compute_hits(ranked: Indices, positives: Sequence[Indices]) -> Hits:
    """Return a (queries, k) bool array: whether each ranked database index is a positive."""
    hits = [np.isin(row, rows) for row, rows in zip(ranked, positives, strict=True)]
    return np.array(hits, bool).reshape(ranked.shape)


def recall_at_k(
    ranked: Indices, positives: Sequence[Indices], ks: Sequence[int] = (1, 5, 10)
) -> dict[int, float]:
    """Compute recall@k, from 0 to 1: the share of queries with a positive among their first k.

    `ranked` are (queries, depth) database indices, best first. A query without positives counts as
    a miss. NaN without queries; ValueError if the numbers of rankings and queries differ.
    """
    if len(ranked) != len(positives):
        raise ValueError(f"{len(ranked)} rankings for {len(positives)} queries")
    hits = compute_hits(ranked, positives)
    return {k: float(hits[:, :k].any(axis=1).mean()) if len(hits) else float("nan") for k in ks}
