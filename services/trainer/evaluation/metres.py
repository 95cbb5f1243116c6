"""How far each ranked photo was taken from its query."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.nearest import Indices
from shared.datasets.distances import pairwise_distances_m
from shared.datasets.sets import DatasetPhoto

Distances = NDArray[np.float64]


def match_distances(
    queries: Sequence[DatasetPhoto], database: Sequence[DatasetPhoto], ranked: Indices
) -> Distances:
    """(queries, k) database indices -> (queries, k) metres, NaN where one has no position."""
    asked = [query for query, row in zip(queries, ranked, strict=True) for _ in row]
    found = [database[number] for number in ranked.ravel().tolist()]
    return pairwise_distances_m(asked, found).reshape(ranked.shape)
