"""Which of the ranked database photos are right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.nearest import Indices

Hits = NDArray[np.bool_]


def compute_hits(ranked: Indices, positives: Sequence[Indices]) -> Hits:
    """(queries, k) database indices, each query's positives -> (queries, k), True where right."""
    rows = [np.isin(row, found) for row, found in zip(ranked, positives, strict=True)]
    return np.array(rows, bool).reshape(ranked.shape)


def hits_at_k(hits: Hits, ks: Sequence[int]) -> NDArray[np.float64]:
    """(queries, k) -> (queries, len(ks)): 1.0 where one of the first k is right, else 0.0."""
    columns = [hits[:, :k].any(axis=1) for k in ks]
    return np.stack(columns, axis=1).astype(np.float64)
