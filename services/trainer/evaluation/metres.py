"""How far each ranked photo was taken from its query."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.nearest import Indices
from shared.datasets.distances import metres_apart
from shared.datasets.sets import Shot

Metres = NDArray[np.float64]


def metres_of(queries: Sequence[Shot], database: Sequence[Shot], ranked: Indices) -> Metres:
    """(queries, k) database indices -> (queries, k) metres, NaN where one has no position."""
    asked = [query for query, row in zip(queries, ranked, strict=True) for _ in row]
    found = [database[number] for number in ranked.ravel().tolist()]
    return metres_apart(asked, found).reshape(ranked.shape)
