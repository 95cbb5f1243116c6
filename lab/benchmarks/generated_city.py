"""Generated city as the input of a benchmark: its files, and which photos show a query's place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lab.city.plan import CityOptions, make_plan, positions_m
from lab.city.write import write_city
from lab.evaluation.recall import positives_within
from shared.imaging.preprocessing import Pixels

if TYPE_CHECKING:
    from rich.progress import Progress

    from shared.descriptors.extractor import Extractor


@dataclass(frozen=True, slots=True)
class GeneratedCity:
    """Paths of the photos, and for each query the indices of the database photos within 25 m."""

    database: list[Path]
    queries: list[Path]
    positives: list[NDArray[np.int64]]


def generate_city(options: CityOptions, folder: Path, progress: Progress) -> GeneratedCity:
    """Write the photos of a city; queries whose place is not in the map are left out."""
    plan = make_plan(options)
    bar = progress.add_task("rendering", total=len(plan.photos))
    write_city(plan, folder, lambda count: progress.advance(bar, count))
    database, queries = plan.evaluation_photos()
    return GeneratedCity(
        [photo.path(folder) for photo in database],
        [photo.path(folder) for photo in queries],
        positives_within(positions_m(queries), positions_m(database)),
    )


def load_pixels(extractor: Extractor, path: Path) -> Pixels:
    """Decode and preprocess a photo for the extractor."""
    with Image.open(path) as image:
        return extractor.preprocessing.apply(image.convert("RGB"))
