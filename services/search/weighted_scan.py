"""Exact top-k by the weighted query, each photo with its plain cosine beside."""

from __future__ import annotations

from collections.abc import Sequence
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.scan import FLOAT32_MARGIN, Scan, UnitQuery, candidates
from services.search.snapshot import LoadedChunk
from shared.photo_filter import EVERYTHING, PhotoFilter


def weighted_top_k(
    chunks: Sequence[LoadedChunk],
    query: UnitQuery,
    weighted: UnitQuery,
    k: int,
    *,
    min_score: float | None = None,
    wanted: PhotoFilter = EVERYTHING,
    exclude: frozenset[UUID] = frozenset(),
) -> tuple[list[tuple[UUID, float, float]], int, int]:
    """The k photos most similar to `weighted` that pass the filter, of those whose cosine to
    `query` is at least `min_score`: (photo, cosine to `query`, cosine to `weighted`); the rows
    scanned, the rows scored again.

    Both queries are unit vectors. Order: the weighted score, highest first; equal ones by photo id.
    """
    scan = Scan(chunks, weighted, wanted, exclude)
    passing = np.arange(len(scan.scores))
    if min_score is not None:
        plain = Scan(chunks, query, wanted, exclude)
        passing = _at_least(min_score, plain, query)
    ranked = [
        (scan.exact(number, weighted), scan.photo_id(number), scan.exact(number, query))
        for number in passing[candidates(scan.scores[passing], k)].tolist()
    ]
    ranked.sort(key=lambda hit: (-hit[0], hit[1]))
    hits = [(photo_id, score, weighted_score) for weighted_score, photo_id, score in ranked]
    return hits[:k], len(scan.scores), len(ranked)


def _at_least(min_score: float, plain: Scan, query: UnitQuery) -> NDArray[np.intp]:
    """The rows whose exact cosine is at least that: those near the bound are scored again."""
    passes = plain.scores >= min_score
    for number in np.flatnonzero(np.abs(plain.scores - min_score) <= FLOAT32_MARGIN).tolist():
        passes[number] = plain.exact(number, query) >= min_score
    return np.flatnonzero(passes)
