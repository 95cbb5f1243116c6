"""bfloat16 against float32: local features, descriptors and recall on the same photos.

    placewise bench precision [--extractor NAME] [--places 60] [--queries 60] [--device auto]

The photos are those of a generated city; both precisions use the vocabulary of float32. Reported:
mean and minimum of the cosine between the two results of a patch and of a photo, and the queries
whose first result is right. The recalls are comparable with each other only.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from lab.benchmarks.descriptors.extract import BenchmarkedExtractor, fit_or_load_centres
from lab.benchmarks.generated_city import generate_city, load_pixels
from lab.benchmarks.report import Report
from lab.city.plan import CityOptions
from lab.evaluation.recall import rank_by_similarity, recall_at_k
from shared.descriptors.inference import PRECISIONS, Precision

if TYPE_CHECKING:
    from rich.progress import Progress

MIN_PATCH_COSINE = 0.999
MAX_QUERY_DIFFERENCE = 1
FIT_PHOTOS = 32  # photos for fitting a vocabulary if none is shipped

Rows = NDArray[np.float32]


def measure(
    progress: Progress, *, extractor: str, places: int, queries: int, device: str, batch: int
) -> Report:
    """Compare both precisions on a city with two views per place."""
    options = CityOptions(places, 2, queries, 0, 0, 0.0, 320, 240, train=False)
    cosines: list[Rows] = []
    rows: dict[Precision, list[Rows]] = {precision: [] for precision in PRECISIONS}
    with tempfile.TemporaryDirectory() as folder:
        measured = BenchmarkedExtractor.of(extractor, device, Path(folder))
        single = measured.load("float32")
        city = generate_city(options, Path(folder, "city"), progress)
        files = [*city.database, *city.queries]
        centres = fit_or_load_centres(single, [load_pixels(single, f) for f in files[:FIT_PHOTOS]])
        bar = progress.add_task("describing in both precisions", total=len(files))
        for begin in range(0, len(files), batch):
            photos = [load_pixels(single, file) for file in files[begin : begin + batch]]
            features: list[torch.Tensor] = []
            for precision in PRECISIONS:
                made = single.with_precision(precision)
                features.append(torch.stack(made.local_features(photos)))
                rows[precision].append(made.describe(photos, centres))
            cosines.append((features[0] * features[1]).sum(dim=-1).flatten().numpy())
            progress.advance(bar, len(photos))
    report = Report(f"{measured.title}: bfloat16 against float32")
    patches = np.concatenate(cosines)
    report.add("patches, mean cosine", float(patches.mean()), at_least=MIN_PATCH_COSINE)
    report.add("patches, least cosine", float(patches.min()))
    described = {precision: np.concatenate(parts) for precision, parts in rows.items()}
    photo_cosines = (described["float32"] * described["bfloat16"]).sum(axis=1)
    report.add("descriptors, mean cosine", float(photo_cosines.mean()))
    report.add("descriptors, least cosine", float(photo_cosines.min()))
    split, count = len(city.database), len(city.queries)
    right = {}
    for precision, found in described.items():
        ranked = rank_by_similarity(found[split:], found[:split], 1)
        right[precision] = round(recall_at_k(ranked, city.positives, (1,))[1] * count)
        report.add(f"queries right at rank 1 in {precision}, of {count}", right[precision])
    difference = abs(right["float32"] - right["bfloat16"])
    report.add("difference of right queries", difference, at_most=MAX_QUERY_DIFFERENCE)
    report.details = {
        "random_weights": measured.random,
        "photos": len(files),
        "torch": torch.__version__,
    }
    return report
