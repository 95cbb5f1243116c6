"""Difficulty of a generated city: recall of baselines from average colour to the default extractor.

Weak baselines (mean colour, colour histogram, thumbnail) must find almost nothing and strong ones
must differ; otherwise the city measures nothing: a data set on which a weak one recognises places
can be solved by colour or layout alone. Results on a generated city are not comparable with
published ones. Baselines with a vocabulary are also evaluated with word weights, fitted in memory
on the database rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.progress import Progress

from lab.city.plan import CityPlan, positions_m
from lab.evaluation.exact_knn import exact_knn
from lab.evaluation.recall import positives_within, recall_at_k
from shared.evaluation.places.evidence import PhotoLocation
from shared.utm_filenames import upload_fields_of_file_name
from shared.word_weights.training_pairs import sample_pairs
from shared.word_weights.weights import PairStatistics, apply_word_weights, empty_pair_statistics

SEED = 0

Rows = NDArray[np.float32]

COLOUR_BINS = 8
"""bins per channel"""
THUMBNAIL_PIXELS = 16
"""side of the thumbnail"""


def average_colour(photo: Image.Image) -> Rows:
    """Return the mean colour as a unit vector, (4,) float32.

    The centred colour gets a constant fourth component before normalisation, so that the cosine
    orders photos as the distance of their colours does.
    """
    mean = np.asarray(photo.resize((1, 1), Image.Resampling.BOX), np.float32).ravel() / 255
    return _unit(np.append(mean - 0.5, 1.0).astype(np.float32))


def _colour_histogram(photo: Image.Image) -> Rows:
    """Return the square roots of the joint colour histogram, (COLOUR_BINS ** 3,) float32.

    The cosine of two such vectors is the Bhattacharyya coefficient.
    """
    levels = np.asarray(photo, np.int32) * COLOUR_BINS // 256
    cells = (levels[..., 0] * COLOUR_BINS + levels[..., 1]) * COLOUR_BINS + levels[..., 2]
    return _unit(np.sqrt(np.bincount(cells.ravel(), minlength=COLOUR_BINS**3)).astype(np.float32))


def thumbnail(photo: Image.Image) -> Rows:
    """Return the mean-free grey pixels of a thumbnail, (THUMBNAIL_PIXELS ** 2,) float32.

    The cosine of two such vectors is the normalised cross-correlation.
    """
    small = photo.convert("L").resize((THUMBNAIL_PIXELS, THUMBNAIL_PIXELS), Image.Resampling.BOX)
    pixels = np.asarray(small, np.float32).ravel()
    return _unit(pixels - pixels.mean())


BASELINE_DESCRIPTORS: dict[str, Callable[[Image.Image], Rows]] = {
    "average colour": average_colour,
    "colour histogram": _colour_histogram,
    "thumbnail 16x16": thumbnail,
}


def _unit(row: Rows) -> Rows:
    norm = np.linalg.norm(row)
    return row / norm if norm > 0 else row


def _fit_word_weights(database: Rows, names: Sequence[str], words: int) -> list[float] | None:
    """Fit a weight per visual word on pairs of near and far photos.

    Args:
        database: (n, words * width) rows.
        names: `@UTM@` file names of the rows.
        words: Number of visual words.

    Returns:
        One weight per word, or None if there are too few pairs.
    """
    fields = [upload_fields_of_file_name(name, None) for name in names]
    locations = [PhotoLocation(float(f["latitude"]), float(f["longitude"]), None) for f in fields]
    pairs = sample_pairs(locations, SEED, len(names))
    if not pairs.is_enough:
        return None
    statistics = empty_pair_statistics(words)
    for batch in (*pairs.batches[0], *pairs.batches[1]):
        statistics += PairStatistics.from_rows(database[batch.photos], batch.near, batch.far, words)
    weights: list[float] = statistics.weights().tolist()
    return weights


def _fit_and_apply_word_weights(queries: Rows, weights: Sequence[float]) -> Rows:
    """Weight the words of each query; a query without weighted words is left unchanged."""
    weighted_queries = [apply_word_weights(query, weights) for query in queries]
    return np.stack(
        [
            query if weighted is None else weighted.astype(np.float32)
            for query, weighted in zip(queries, weighted_queries, strict=True)
        ]
    )


BASELINE_KS = (1, 5, 10)


def evaluate_baselines(plan: CityPlan, out: Path, progress: Progress) -> list[dict[str, Any]]:
    """Evaluate all baselines on a generated city, weakest first.

    Args:
        plan: Plan of the city.
        out: Folder of its photos.
        progress: Shows the photos described.

    Returns:
        Per baseline: its name (`rung`) and recalls at BASELINE_KS over all queries within the map
        (`recall`), over those that look the same way as database photos (`recall_in_map`) and over
        those that look the other way (`recall_other_way`); None without such queries.
    """
    database, queries = plan.evaluation_photos()
    if not queries:
        return []
    positives = positives_within(positions_m(queries), positions_m(database))
    other_way = np.array([photo.kind == "other_way" for photo in queries])
    results = []
    described = _describe_photos(
        [photo.path(out) for photo in database + queries], len(database), progress
    )
    for name, query_rows, database_rows in _add_word_weighted(
        *described, [photo.name for photo in database]
    ):
        ranked = exact_knn(query_rows, database_rows, max(BASELINE_KS)).indices
        results.append(
            {
                "rung": name,
                "recall": _recall_shares(ranked, positives, np.ones(len(queries), bool)),
                "recall_in_map": _recall_shares(ranked, positives, ~other_way),
                "recall_other_way": _recall_shares(ranked, positives, other_way),
            }
        )
    return results


def _describe_photos(
    paths: Sequence[Path], database: int, progress: Progress
) -> tuple[list[tuple[str, Rows]], dict[str, int]]:
    """Describe photos with each baseline.

    Args:
        paths: Photo files; the first `database` of them may be fitted on.
        database: Number of database photos.
        progress: Shows the photos described.

    Returns:
        (photos, D) unit rows by baseline, and the number of words of those with a vocabulary.
    """
    from lab.cli.datasets.network_baselines import NetworkBaselines  # imports torch

    bar = progress.add_task("baselines: no network", total=len(paths))
    rows_by_name: dict[str, list[Rows]] = {name: [] for name in BASELINE_DESCRIPTORS}
    for path in paths:
        with Image.open(path) as image:
            photo = image.convert("RGB")
        for name, describe in BASELINE_DESCRIPTORS.items():
            rows_by_name[name].append(describe(photo))
        progress.advance(bar)
    described = [(name, np.stack(rows)) for name, rows in rows_by_name.items()]
    bar = progress.add_task("baselines: networks", total=len(paths))
    advance: Callable[[int], None] = lambda count: progress.advance(bar, count)  # noqa: E731
    networks = NetworkBaselines(paths[:database])
    described += networks.describe(paths, advance).items()
    return described, networks.words


def _add_word_weighted(
    described: Sequence[tuple[str, Rows]], words: Mapping[str, int], names: Sequence[str]
) -> list[tuple[str, Rows, Rows]]:
    """Split rows into queries and database, and add a word-weighted variant per vocabulary.

    Args:
        described: Rows by baseline, database rows first.
        words: Number of words of baselines with a vocabulary.
        names: File names of the database photos.

    Returns:
        (name, query rows, database rows). Cities too small to fit weights get no variants.
    """
    entries = []
    for name, rows in described:
        database, queries = rows[: len(names)], rows[len(names) :]
        entries.append((name, queries, database))
        weights = _fit_word_weights(database, names, words[name]) if name in words else None
        if weights is not None:
            entries.append(
                (f"{name}, word weights", _fit_and_apply_word_weights(queries, weights), database)
            )
    return entries


def _recall_shares(
    ranked: NDArray[np.int64], positives: list[NDArray[np.int64]], selected: NDArray[np.bool_]
) -> dict[str, float] | None:
    if not selected.any():
        return None
    chosen = [p for p, is_selected in zip(positives, selected, strict=True) if is_selected]
    return {
        str(k): share for k, share in recall_at_k(ranked[selected], chosen, BASELINE_KS).items()
    }
