"""Word weights of rows in memory: what the ladder does with files, as a map does with chunks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared.datasets.utm_names import upload_fields_of_file_name
from shared.estimate.places import PhotoLocation
from shared.word_weights.learn import PairStatistics, apply_word_weights, empty_pair_statistics
from shared.word_weights.pairs import sample_pairs

SEED = 0

Rows = NDArray[np.float32]


def fit_word_weights(database: Rows, names: Sequence[str], words: int) -> list[float] | None:
    """One weight for each of the words of (n, words * width) rows, of photos with these @UTM@
    names; None where they have too few pairs to learn from."""
    said = [upload_fields_of_file_name(name, None) for name in names]
    spots = [PhotoLocation(float(one["latitude"]), float(one["longitude"]), None) for one in said]
    chosen = sample_pairs(spots, SEED, len(names))
    if not chosen.is_enough:
        return None
    taught = empty_pair_statistics(words)
    for lesson in (*chosen.batches[0], *chosen.batches[1]):
        taught += PairStatistics.from_rows(database[lesson.photos], lesson.near, lesson.far, words)
    weights: list[float] = taught.weights().tolist()
    return weights


def fit_and_apply_word_weights(queries: Rows, weights: Sequence[float]) -> Rows:
    """The queries with their words weighted; one that has none of the weighted words stays."""
    weighted = [apply_word_weights(query, weights) for query in queries]
    return np.stack(
        [
            query if found is None else found.astype(np.float32)
            for query, found in zip(queries, weighted, strict=True)
        ]
    )
