"""recall@k by position, as visual place recognition measures it.

A database photo within 25 m of a query is a true positive of it: straight-line distance in UTM
metres, 25.00 m included. (VPR-datasets-downloader, deep-visual-geo-localization-benchmark)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

POSITIVE_WITHIN_M = 25.0
QUERIES_AT_ONCE = 256

Positions = NDArray[np.float64]
Descriptors = NDArray[np.float32]
Indices = NDArray[np.int64]


def true_positives(
    queries: Positions, database: Positions, within_m: float = POSITIVE_WITHIN_M
) -> list[Indices]:
    """(n, 2) and (m, 2) UTM metres of one zone -> for each query its positives, ascending."""
    found: list[Indices] = []
    for start in range(0, len(queries), QUERIES_AT_ONCE):
        away = queries[start : start + QUERIES_AT_ONCE, None] - database[None]
        near = np.hypot(away[..., 0], away[..., 1]) <= within_m
        found += [np.flatnonzero(row) for row in near]
    return found


def rank(queries: Descriptors, database: Descriptors, k: int) -> Indices:
    """(n, D) and (m, D) unit rows -> (n, min(k, m)) database indices, most similar first.

    Of equally similar ones the lower index comes first, so that a tie is nobody's luck.
    """
    ranked = []
    for start in range(0, len(queries), QUERIES_AT_ONCE):
        scores = queries[start : start + QUERIES_AT_ONCE] @ database.T
        ranked.append(np.argsort(-scores, axis=1, kind="stable")[:, :k])
    if not ranked:
        return np.empty((0, min(k, len(database))), np.int64)
    return np.concatenate(ranked)


def recall_at(
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
