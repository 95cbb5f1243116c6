"""Benchmark of reranking by local features: recall gained and time per photo.

Runs on a generated city, smaller than that of the README, with the default extractor and both of
its vocabularies; and on the real photos of PLACEWISE_TEST_DATA, if it is set. Times are of one
core, and include the effect of other load on the machine.
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
from PIL import Image

from benchmarks.report import Report
from shared.descriptors.aggregation import vlad
from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.reranking import LocalFeatures, rerank_score
from shared.evaluation.recall import positives_within, rank_by_similarity, recall_at_k
from shared.extractor_config.configs import EXTRACTOR_CONFIGS
from shared.imaging.preprocessing import Pixels
from shared.synthetic_city.plan import CityOptions, PlannedPhoto, make_plan
from shared.synthetic_city.write import write_city
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
        database, queries, positives = _draw_city(Path(folder), places, seed, progress)
        bar = progress.add_task("describing", total=len(database) + len(queries))
        described = _describe_city(extractor, database, queries, lambda n: progress.advance(bar, n))
        recompute = _time_features(extractor, database[: max(RERANK_DEPTHS)])
    bar = progress.add_task("reranking", total=len(queries) * 2)
    for vocabulary in ("shipped", "fitted"):
        _report_city(
            report, extractor, described, vocabulary, positives, lambda: progress.advance(bar)
        )
    for depth in RERANK_DEPTHS:
        report.add(f"local features of {depth} photos, made anew", recompute * depth, "s of a core")
    if "PLACEWISE_TEST_DATA" in os.environ:
        _report_real_photos(
            report, extractor, Path(os.environ["PLACEWISE_TEST_DATA"]) / "toy-places"
        )
    return report


def _draw_city(
    folder: Path, places: int, seed: int, progress: Progress
) -> tuple[list[Path], list[Path], list[Indices]]:
    """Return paths of database and queries, and the positives of each query."""
    plan = make_plan(CityOptions(places, 4, max(1, places // 2), seed, 0, 0.1, 320, 240, False))
    bar = progress.add_task("drawing", total=len(plan.photos))
    write_city(plan, folder, lambda count: progress.advance(bar, count))
    database = [shot for shot in plan.photos if shot.role == "database"]
    queries = [s for s in plan.photos if s.role == "query" and s.kind != "out_of_map"]

    def paths(shots: Sequence[PlannedPhoto]) -> list[Path]:
        return [folder / shot.folder / shot.name for shot in shots]

    def positions(shots: Sequence[PlannedPhoto]) -> NDArray[np.float64]:
        return np.array([(shot.camera.x, shot.camera.y) for shot in shots])

    return (
        paths(database),
        paths(queries),
        positives_within(positions(queries), positions(database)),
    )


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
        clusters=extractor.recipe.clusters,
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
        made = extractor.local_features(pixels)
        for photo, one in zip(pixels, made, strict=True):
            features.append(
                LocalFeatures.from_features(one, extractor.backbone.grid(*photo.shape[:2]))
            )
        for name, of_vocabulary in centres.items():
            rows[name].append(vlad(torch.stack(made), of_vocabulary).numpy())
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
    took = []
    for query in range(len(ranked)):
        started = time.process_time()
        scores[query] = _rerank_scores(
            extractor, queries, query, database, ranked[query], vocabulary
        )
        took.append((time.process_time() - started) / ranked.shape[1])
        advance()
    for depth in (0, *RERANK_DEPTHS):
        shares = recall_at_k(_apply_rerank(ranked, scores, depth), positives, KS)
        how = f"rerank={depth}" if depth else "without rerank"
        for k, share in shares.items():
            report.add(f"R@{k}, {vocabulary} vocabulary, {how}", 100 * share, "%")
    for depth in RERANK_DEPTHS:
        report.add(
            f"comparing {depth} photos, {vocabulary}, median", median(took) * depth, "s of a core"
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
    took = []
    for _ in range(TIMING_ROUNDS):
        started = time.process_time()
        for pixels in _batches(extractor, paths):
            extractor.local_features(pixels)
        took.append((time.process_time() - started) / len(paths))
    return median(took)


def _report_real_photos(report: Report, extractor: Extractor, folder: Path) -> None:
    """Report the ranks of the true matches before and after reranking all photos."""
    database = sorted((folder / "database").glob("*.jpg"))
    queries = [folder / "queries" / name for name in TRUE_MATCH]
    photos, asked = _describe_city(extractor, database, queries, lambda count: None)
    truth = [[path.name for path in database].index(match) for match in TRUE_MATCH.values()]
    for vocabulary in ("shipped", "fitted"):
        ranked = rank_by_similarity(asked.rows[vocabulary], photos.rows[vocabulary], len(database))
        scores = np.array(
            [
                _rerank_scores(extractor, asked, query, photos, ranked[query], vocabulary)
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
        batch = []
        for path in paths[begin : begin + BATCH]:
            with Image.open(path) as image:
                batch.append(extractor.preprocessing.apply(image.convert("RGB")))
        yield batch
