"""Word weights of rows in memory: what the ladder does with files, as a map does with chunks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared.datasets.utm_names import fields_of_name
from shared.estimate.places import Spot
from shared.word_weights.learn import Taught, nothing_taught, weigh
from shared.word_weights.pairs import choose_pairs

SEED = 0

Rows = NDArray[np.float32]


def learn_weights(database: Rows, names: Sequence[str], words: int) -> list[float] | None:
    """One weight for each of the words of (n, words * width) rows, of photos with these @UTM@
    names; None where they have too few pairs to learn from."""
    said = [fields_of_name(name, None) for name in names]
    spots = [Spot(float(one["latitude"]), float(one["longitude"]), None) for one in said]
    chosen = choose_pairs(spots, SEED, len(names))
    if not chosen.is_enough:
        return None
    taught = nothing_taught(words)
    for lesson in (*chosen.lessons[0], *chosen.lessons[1]):
        taught += Taught.of(database[lesson.photos], lesson.near, lesson.far, words)
    weights: list[float] = taught.weights().tolist()
    return weights


def weigh_rows(queries: Rows, weights: Sequence[float]) -> Rows:
    """The queries with their words weighted; one that has none of the weighted words stays."""
    weighted = [weigh(query, weights) for query in queries]
    return np.stack(
        [
            query if found is None else found.astype(np.float32)
            for query, found in zip(queries, weighted, strict=True)
        ]
    )
