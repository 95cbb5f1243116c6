"""Reranking by local features: recall gained, and CPU time per photo.

    placewise bench rerank [--places 150] [--seed 0]

Runs on a generated city with the default extractor and both of its vocabularies; and on the real
photos of PLACEWISE_TEST_DATA, if it is set. Reported for each vocabulary: R@1, R@5 and R@10 without
reranking and with `rerank=10`, 25 and 50 (25 m rule), and CPU time on one core.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from lab.benchmarks.generated_city import generate_city, load_pixels
from lab.benchmarks.report import Report
from lab.city.plan import CityOptions
from lab.evaluation.recall import rank_by_similarity, recall_at_k
from shared.descriptors.aggregation import vlad
from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.reranking import LocalFeatures, rerank_score
from shared.extractor_config.configs import EXTRACTOR_CONFIGS
from shared.imaging.preprocessing import Pixels
from tests.e2e.test_real_photos import TRUE_MATCH

if TYPE_CHECKING:
    from rich.progress import Progress

EXTRACTOR = "efficientnet-lite0-vlad"
RERANK_DEPTHS = (10, 25, 50)
KS = (1, 5, 10)
BATCH = 16
FIT_PHOTOS = 300
SEED = 0
TIMING_ROUNDS = 5  # rounds in which the candidates' features are computed again for timing

Rows = NDArray[np.float32]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class DescribedPhotos:
    """Photos with their descriptors and local features."""

    features: list[LocalFeatures]
    rows: dict[str, Rows]
    """By vocabulary, (photos, dimension)."""


def measure(progress: Progress, *, places: int, seed: int) -> Report:
    """Rerank on a generated city of `places` with four photos each and half as many queries."""
    extractor = Extractor(EXTRACTOR_CONFIGS[EXTRACTOR], choose_device("auto"))
    report = Report(f"Reranking {places} generated places, seed {seed}")
    with tempfile.TemporaryDirectory() as folder:
        options = CityOptions(places, 4, max(1, places // 2), seed, 0, 0.1, 320, 240, train=False)
        city = generate_city(options, Path(folder), progress)
        bar = progress.add_task("describing", total=len(city.database) + len(city.queries))
        described = _describe_city(
            extractor, city.database, city.queries, lambda n: progress.advance(bar, n)
        )
        seconds_per_photo = _time_features(extractor, city.database[: max(RERANK_DEPTHS)])
    bar = progress.add_task("reranking", total=len(city.queries) * 2)
    for vocabulary in ("shipped", "fitted"):
        _report_city(
            report, extractor, described, vocabulary, city.positives, lambda: progress.advance(bar)
        )
    for depth in RERANK_DEPTHS:
        report.add(f"computing features of {depth} photos", seconds_per_photo * depth, "s of CPU")
    if "PLACEWISE_TEST_DATA" in os.environ:
        _report_real_photos(
            report, extractor, Path(os.environ["PLACEWISE_TEST_DATA"]) / "toy-places"
        )
    return report


def _describe_city(
    extractor: Extractor,
    database: Sequence[Path],
    queries: Sequence[Path],
    advance: Callable[[int], None],
) -> tuple[DescribedPhotos, DescribedPhotos]:
    """Describe database and queries, with the shipped and with a fitted vocabulary."""
    chosen = sample_photos(len(database), FIT_PHOTOS, extractor.backbone.width, SEED)
    fitted = fit_vocabulary(
        extractor,
        _batches(extractor, [database[number] for number in chosen]),
        len(chosen),
        clusters=extractor.config.clusters,
        seed=SEED,
    )
    shipped = extractor.shipped_vocabulary()
    assert shipped is not None
    centres = {
        name: torch.from_numpy(one.array)
        for name, one in (("shipped", shipped[0]), ("fitted", fitted.centres))
    }
    return (
        _describe_photos(extractor, database, centres, advance),
        _describe_photos(extractor, queries, centres, advance),
    )


def _describe_photos(
    extractor: Extractor,
    paths: Sequence[Path],
    centres: dict[str, torch.Tensor],
    advance: Callable[[int], None],
) -> DescribedPhotos:
    features: list[LocalFeatures] = []
    rows: dict[str, list[Rows]] = {name: [] for name in centres}
    for pixels in _batches(extractor, paths):
        features_of_batch = extractor.local_features(pixels)
        for photo, one in zip(pixels, features_of_batch, strict=True):
            features.append(
                LocalFeatures.from_features(one, extractor.backbone.grid(*photo.shape[:2]))
            )
        for name, of_vocabulary in centres.items():
            rows[name].append(vlad(torch.stack(features_of_batch), of_vocabulary).numpy())
        advance(len(pixels))
    return DescribedPhotos(features, {name: np.concatenate(parts) for name, parts in rows.items()})


def _report_city(
    report: Report,
    extractor: Extractor,
    described: tuple[DescribedPhotos, DescribedPhotos],
    vocabulary: str,
    positives: list[Indices],
    advance: Callable[[], object],
) -> None:
    database, queries = described
    ranked = rank_by_similarity(
        queries.rows[vocabulary], database.rows[vocabulary], max(RERANK_DEPTHS)
    )
    scores = np.empty(ranked.shape)
    durations = []
    for query in range(len(ranked)):
        started = time.process_time()
        scores[query] = _rerank_scores(
            extractor, queries, query, database, ranked[query], vocabulary
        )
        durations.append((time.process_time() - started) / ranked.shape[1])
        advance()
    for depth in (0, *RERANK_DEPTHS):
        shares = recall_at_k(_apply_rerank(ranked, scores, depth), positives, KS)
        how = f"rerank={depth}" if depth else "without rerank"
        for k, share in shares.items():
            report.add(f"R@{k}, {vocabulary} vocabulary, {how}", 100 * share, "%")
    for depth in RERANK_DEPTHS:
        report.add(
            f"comparing {depth} photos, {vocabulary}, median", median(durations) * depth, "s of CPU"
        )


def _rerank_scores(
    extractor: Extractor,
    queries: DescribedPhotos,
    query: int,
    database: DescribedPhotos,
    candidates: Indices,
    vocabulary: str,
) -> list[float]:
    cosines = database.rows[vocabulary][candidates] @ queries.rows[vocabulary][query]
    device = extractor.backbone.device
    return [
        rerank_score(float(cosine), queries.features[query], database.features[photo], device)
        for cosine, photo in zip(cosines, candidates, strict=True)
    ]


def _apply_rerank(ranked: Indices, scores: NDArray[np.float64], depth: int) -> Indices:
    """Return the rankings with their first `depth` photos reordered by score."""
    order = np.argsort(-scores[:, :depth], axis=1, kind="stable")
    first = np.take_along_axis(ranked[:, :depth], order, axis=1)
    return np.concatenate([first, ranked[:, depth:]], axis=1)


def _time_features(extractor: Extractor, paths: Sequence[Path]) -> float:
    """Return the seconds of one core for reading, decoding and the network, per photo."""
    durations = []
    for _ in range(TIMING_ROUNDS):
        started = time.process_time()
        for pixels in _batches(extractor, paths):
            extractor.local_features(pixels)
        durations.append((time.process_time() - started) / len(paths))
    return median(durations)


def _report_real_photos(report: Report, extractor: Extractor, folder: Path) -> None:
    """Report the ranks of the true matches before and after reranking all photos."""
    database = sorted((folder / "database").glob("*.jpg"))
    queries = [folder / "queries" / name for name in TRUE_MATCH]
    photos, query_photos = _describe_city(extractor, database, queries, lambda count: None)
    truth = [[path.name for path in database].index(match) for match in TRUE_MATCH.values()]
    for vocabulary in ("shipped", "fitted"):
        ranked = rank_by_similarity(
            query_photos.rows[vocabulary], photos.rows[vocabulary], len(database)
        )
        scores = np.array(
            [
                _rerank_scores(extractor, query_photos, query, photos, ranked[query], vocabulary)
                for query in range(len(queries))
            ]
        )
        for name, order in (
            ("without rerank", ranked),
            ("reranked", _apply_rerank(ranked, scores, len(database))),
        ):
            for query, path in enumerate(queries):
                place = int(np.flatnonzero(order[query] == truth[query])[0]) + 1
                report.add(f"real {path.stem}, {vocabulary}, {name}: rank", place)


def _batches(extractor: Extractor, paths: Sequence[Path]) -> Iterator[list[Pixels]]:
    for begin in range(0, len(paths), BATCH):
        yield [load_pixels(extractor, path) for path in paths[begin : begin + BATCH]]
