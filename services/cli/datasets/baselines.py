"""The ladder: how hard a generated city is, from average colour up to the default extractor.

Its lower rungs must find next to nothing and its upper ones must differ, or the city measures
nothing. Figures of a generated city are never comparable with published ones.

Word weights of rows in memory: what the ladder does with files, as a map does with chunks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.progress import Progress

from shared.datasets.utm_filenames import upload_fields_of_file_name
from shared.evaluation.baselines import BASELINE_DESCRIPTORS
from shared.evaluation.place_evidence import PhotoLocation
from shared.evaluation.recall import positives_within, rank_by_similarity, recall_at_k
from shared.synthetic_city.plan import CityPlan, PlannedPhoto
from shared.word_weights.training_pairs import sample_pairs
from shared.word_weights.weights import PairStatistics, apply_word_weights, empty_pair_statistics

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


BASELINE_KS = (1, 5, 10)


def evaluate_baselines(plan: CityPlan, out: Path, progress: Progress) -> list[dict[str, Any]]:
    """Each rung's name and recalls over the queries on the map, weakest first.

    `recall` is over all of them; `recall_in_map` and `recall_other_way` over the two kinds, the
    latter None where there is none.
    """
    database = [shot for shot in plan.photos if shot.role == "database"]
    queries = [s for s in plan.photos if s.role == "query" and s.kind != "out_of_map"]
    if not queries:
        return []
    positives = positives_within(_positions(queries), _positions(database))
    other_way = np.array([shot.kind == "other_way" for shot in queries])
    rungs = []
    described = _describe_photos(
        [out / s.folder / s.name for s in database + queries], len(database), progress
    )
    for name, asked, rows in _add_word_weighted(*described, [shot.name for shot in database]):
        ranked = rank_by_similarity(asked, rows, max(BASELINE_KS))
        rungs.append(
            {
                "rung": name,
                "recall": _recall_shares(ranked, positives, np.ones(len(queries), bool)),
                "recall_in_map": _recall_shares(ranked, positives, ~other_way),
                "recall_other_way": _recall_shares(ranked, positives, other_way),
            }
        )
    return rungs


def _describe_photos(
    paths: Sequence[Path], database: int, progress: Progress
) -> tuple[list[tuple[str, Rows]], dict[str, int]]:
    """(photos, D) unit rows by each rung, and the words of those that have a vocabulary; the first
    `database` paths may be learnt from."""
    from services.cli.datasets.network_baselines import NetworkBaselines  # torch takes seconds

    bar = progress.add_task("ladder: no network", total=len(paths))
    weak: dict[str, list[Rows]] = {name: [] for name in BASELINE_DESCRIPTORS}
    for path in paths:
        with Image.open(path) as image:
            photo = image.convert("RGB")
        for name, describe in BASELINE_DESCRIPTORS.items():
            weak[name].append(describe(photo))
        progress.advance(bar)
    found = [(name, np.stack(rows)) for name, rows in weak.items()]
    bar = progress.add_task("ladder: networks", total=len(paths))
    advance: Callable[[int], None] = lambda count: progress.advance(bar, count)  # noqa: E731
    networks = NetworkBaselines(paths[:database])
    found += networks.describe(paths, advance).items()
    return found, networks.words


def _add_word_weighted(
    described: Sequence[tuple[str, Rows]], words: Mapping[str, int], names: Sequence[str]
) -> list[tuple[str, Rows, Rows]]:
    """(rung, queries, database rows); after each rung with so many words one more, whose queries
    are weighted by what the database, of those file names, has taught. A city that is too small to
    teach has none of these."""
    found = []
    for name, rows in described:
        database, queries = rows[: len(names)], rows[len(names) :]
        found.append((name, queries, database))
        weights = fit_word_weights(database, names, words[name]) if name in words else None
        if weights is not None:
            found.append(
                (f"{name}, word weights", fit_and_apply_word_weights(queries, weights), database)
            )
    return found


def _positions(shots: Sequence[PlannedPhoto]) -> NDArray[np.float64]:
    return np.array([(shot.camera.x, shot.camera.y) for shot in shots])


def _recall_shares(
    ranked: NDArray[np.int64], positives: list[NDArray[np.int64]], selected: NDArray[np.bool_]
) -> dict[str, float] | None:
    if not selected.any():
        return None
    chosen = [found for found, meant in zip(positives, selected, strict=True) if meant]
    return {
        str(k): share for k, share in recall_at_k(ranked[selected], chosen, BASELINE_KS).items()
    }
