"""Benchmark of bfloat16 against float32: features, descriptors and recall on the same photos.

The photos are of a generated city. The recalls are comparable with each other only.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.extract import BenchmarkedExtractor, fit_or_load_centres
from benchmarks.report import Report
from shared.descriptors.extractor import Extractor
from shared.descriptors.inference import PRECISIONS, Precision
from shared.descriptors.vocabulary import ClusterCentres
from shared.evaluation.recall import positives_within, rank_by_similarity, recall_at_k
from shared.imaging.preprocessing import Pixels
from shared.synthetic_city.plan import CityOptions, PlannedPhoto, make_plan
from shared.synthetic_city.write import write_city

if TYPE_CHECKING:
    from rich.progress import Progress

TARGET_PATCH_COSINE = 0.999
MAX_QUERY_DIFFERENCE = 1
SIZE = 320, 240
VIEWS = 2
FIT_PHOTOS = 32  # photos for fitting a vocabulary if none is shipped

Rows = NDArray[np.float32]


def measure(
    progress: Progress, *, extractor: str, places: int, queries: int, device: str, batch: int
) -> Report:
    """Compare both precisions on a city with two views per place, with the float32 vocabulary."""
    with tempfile.TemporaryDirectory() as folder:
        measured = BenchmarkedExtractor.of(extractor, device, Path(folder))
        single = measured.load("float32")
        shots, files = _draw_city(progress, Path(folder, "city"), places, queries)
        found = _PrecisionComparison(
            single,
            fit_or_load_centres(single, [_load_pixels(single, f) for f in files[:FIT_PHOTOS]]),
        )
        bar = progress.add_task("describing in both precisions", total=len(files))
        for begin in range(0, len(files), batch):
            chosen = [_load_pixels(single, file) for file in files[begin : begin + batch]]
            found.add(chosen)
            progress.advance(bar, len(chosen))
    report = Report(f"{measured.title}: bfloat16 against float32")
    found.tell(report, shots)
    report.details = {
        "random_weights": measured.random,
        "photos": len(files),
        "torch": torch.__version__,
    }
    return report


@dataclass(slots=True)
class _PrecisionComparison:
    """Descriptors computed so far in both precisions."""

    single: Extractor
    centres: ClusterCentres | None
    patch_cosines: list[Rows] = field(default_factory=list)
    rows: dict[Precision, list[Rows]] = field(
        default_factory=lambda: {precision: [] for precision in PRECISIONS}
    )

    def add(self, photos: list[Pixels]) -> None:
        local: list[torch.Tensor] = []
        for precision in PRECISIONS:
            made = self.single.with_precision(precision)
            local.append(torch.stack(made.local_features(photos)))
            self.rows[precision].append(made.describe(photos, self.centres))
        self.patch_cosines.append((local[0] * local[1]).sum(dim=-1).flatten().numpy())

    def tell(self, report: Report, shots: Sequence[PlannedPhoto]) -> None:
        patches = np.concatenate(self.patch_cosines)
        report.add(
            "patches, mean cosine",
            float(patches.mean()),
            at_least=TARGET_PATCH_COSINE,
        )
        report.add("patches, least cosine", float(patches.min()))
        rows = {precision: np.concatenate(found) for precision, found in self.rows.items()}
        cosines = (rows["float32"] * rows["bfloat16"]).sum(axis=1)
        report.add("descriptors, mean cosine", float(cosines.mean()))
        report.add("descriptors, least cosine", float(cosines.min()))
        database = np.array([shot.role == "database" for shot in shots])
        positions = np.array([(shot.camera.x, shot.camera.y) for shot in shots])
        positives = positives_within(positions[~database], positions[database])
        right = {}
        for precision, found in rows.items():
            ranked = rank_by_similarity(found[~database], found[database], 1)
            right[precision] = round(recall_at_k(ranked, positives, (1,))[1] * len(positives))
            report.add(f"queries found first in {precision}, of {len(positives)}", right[precision])
        apart = abs(right["float32"] - right["bfloat16"])
        report.add("queries apart", apart, at_most=MAX_QUERY_DIFFERENCE)


def _draw_city(
    progress: Progress, out: Path, places: int, queries: int
) -> tuple[list[PlannedPhoto], list[Path]]:
    """Return the photos of the database and of the queries, and their files."""
    width, height = SIZE
    plan = make_plan(
        CityOptions(
            places=places,
            views=VIEWS,
            queries=queries,
            seed=0,
            catalogue_seed=0,
            out_of_map=0,
            width=width,
            height=height,
            train=False,
        )
    )
    bar = progress.add_task("drawing the city", total=len(plan.photos))
    write_city(plan, out, lambda count: progress.advance(bar, count))
    return list(plan.photos), [out / shot.folder / shot.name for shot in plan.photos]


def _load_pixels(extractor: Extractor, file: Path) -> Pixels:
    with Image.open(file) as image:
        return extractor.preprocessing.apply(image.convert("RGB"))
