"""Difficulty of a generated city: recall of baselines from average colour to the default extractor.

Weak baselines (mean colour, colour histogram, thumbnail) must find almost nothing and strong ones
must differ; otherwise the city measures nothing: a data set on which a weak one recognises places
can be solved by colour or layout alone. Results on a generated city are not comparable with
published ones. Baselines with a vocabulary are also evaluated with word weights, fitted in memory
on the database rows, and the fitted one after PCA whitening.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.progress import Progress

from lab.city.plan import CityPlan, positions_m
from lab.datasets.open_dataset import open_evaluation_set
from lab.evaluation.exact_knn import exact_knn
from lab.evaluation.recall import positives_within, recall_at_k
from services.cli.environment import read_settings
from shared.evaluation.places.evidence import PhotoLocation
from shared.extractor_config.configs import EXTRACTOR_CONFIGS
from shared.utm_filenames import upload_fields_of_file_name
from shared.word_weights.training_pairs import sample_pairs
from shared.word_weights.weights import PairStatistics, apply_word_weights, empty_pair_statistics

SEED = 0
EXTRACTOR = "efficientnet-lite0-vlad128"
PCA_DIMENSIONS = (512, 256, 128)
"""Those that exceed the number of database photos are skipped"""

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


@cache
def _untrained_network() -> Any:
    import timm
    import torch

    torch.manual_seed(SEED)
    network = timm.create_model(
        "tf_efficientnet_lite0", pretrained=False, features_only=True, out_indices=(3,)
    )
    return network.eval().requires_grad_(False)


def _untrained_descriptor(photo: Image.Image) -> Rows:
    """Return the mean of the features of EfficientNet-Lite0 with random weights."""
    import torch

    pixels = np.asarray(photo, np.float32).transpose(2, 0, 1)[None] / 127.5 - 1
    with torch.inference_mode():
        features = _untrained_network()(torch.from_numpy(pixels))[0][0].flatten(1).numpy()
    lengths = np.linalg.norm(features, axis=0, keepdims=True)
    return _unit((features / np.maximum(lengths, 1e-12)).mean(axis=1))


BASELINE_DESCRIPTORS: dict[str, Callable[[Image.Image], Rows]] = {
    "average colour": average_colour,
    "colour histogram": _colour_histogram,
    "thumbnail 16x16": thumbnail,
    "untrained network": _untrained_descriptor,
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


def _apply_word_weights(queries: Rows, weights: Sequence[float]) -> Rows:
    """Weight the words of each query; a query without weighted words is left unchanged."""
    weighted = [apply_word_weights(query, weights) for query in queries]
    return np.stack(
        [q if w is None else w.astype(np.float32) for q, w in zip(queries, weighted, strict=True)]
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
    paths = [photo.path(out) for photo in database + queries]
    results = []
    for name, query_rows, database_rows in (
        *_describe_without_vocabulary(paths, len(database), progress),
        *_describe_with_vocabulary(out, paths, len(database), progress),
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


Described = tuple[str, Rows, Rows]
"""Name of a baseline, and its rows of the queries and of the database"""


def _describe_without_vocabulary(
    paths: Sequence[Path], database: int, progress: Progress
) -> Iterator[Described]:
    """Yield the rows of photos, of which the first `database` are those of the database."""
    bar = progress.add_task("baselines: photos", total=len(paths))
    rows_by_name: dict[str, list[Rows]] = {name: [] for name in BASELINE_DESCRIPTORS}
    for path in paths:
        with Image.open(path) as image:
            photo = image.convert("RGB")
        for name, describe in BASELINE_DESCRIPTORS.items():
            rows_by_name[name].append(describe(photo))
        progress.advance(bar)
    for name, rows in rows_by_name.items():
        yield name, np.stack(rows[database:]), np.stack(rows[:database])


def _describe_with_vocabulary(
    out: Path, paths: Sequence[Path], database: int, progress: Progress
) -> Iterator[Described]:
    """Yield the rows of EXTRACTOR, with word weights where the city is large enough for them."""
    from lab.cli.evaluation.compare_extractors import whiten_set  # imports torch
    from lab.cli.evaluation.describers import extractor_describer

    settings, evaluation_set = read_settings(), open_evaluation_set(out)
    names = [path.name for path in paths[:database]]
    for vocabulary in ("shipped", "fitted"):
        name, fit = f"{EXTRACTOR}, {vocabulary} vocabulary", vocabulary == "fitted"
        describer = extractor_describer(
            EXTRACTOR, None, evaluation_set, settings, progress, fit=fit
        )
        bar = progress.add_task(f"baselines: {vocabulary} vocabulary", total=len(paths))
        batches = []
        for batch in describer.describe(paths):
            batches.append(batch)
            progress.advance(bar, len(batch))
        rows = np.concatenate(batches)
        queries, of_map = rows[database:], rows[:database]
        yield name, queries, of_map
        words = rows.shape[1] // EXTRACTOR_CONFIGS[EXTRACTOR].width
        weights = _fit_word_weights(of_map, names, words)
        if weights is not None:
            yield f"{name}, word weights", _apply_word_weights(queries, weights), of_map
        for dimension in PCA_DIMENSIONS if fit else ():
            if database > dimension:
                reduced, of_queries, _ = whiten_set(of_map, queries, dimension, settings.device)
                yield f"{name}, PCA to {dimension}", of_queries, reduced


def _recall_shares(
    ranked: NDArray[np.int64], positives: list[NDArray[np.int64]], selected: NDArray[np.bool_]
) -> dict[str, float] | None:
    if not selected.any():
        return None
    chosen = [p for p, is_selected in zip(positives, selected, strict=True) if is_selected]
    return {
        str(k): share for k, share in recall_at_k(ranked[selected], chosen, BASELINE_KS).items()
    }
