"""Fits the prior of place models on generated cities and writes it to `place_prior.json`.

    placewise datasets synth CITY --no-ladder --no-train --seed 1 ...   (several cities)
    python -m tools.make_place_prior CITY [CITY ...]

Only coefficients are stored. Each city is described by the default extractor, with a vocabulary
fitted on it, and sampled as a live map is (`place_samples`): once with its coordinates, and once
with label paths, which are squares of 400 m and 100 m and the place.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from services.cli.environment import read_settings
from services.cli.output import console
from shared.datasets.open_dataset import (
    EvaluationSet,
    open_evaluation_set,
)
from shared.datasets.utm_filenames import FileNameLocation, parse_utm_file_name
from shared.evaluation.place_evidence import PhotoLocation
from shared.evaluation.place_fit import (
    PlaceSample,
    RegressionTable,
    fit_map_estimate,
    not_in_map_table,
    sample_weights,
)
from shared.evaluation.place_levels import FEATURES, LevelScheme
from shared.evaluation.place_probability import OUT_OF_MAP_SHARE, PRIOR_FILE, PlacePrior
from shared.evaluation.place_samples import IndexRanking, OwnPhotoSampler

RADII_M = (25.0, 100.0, 500.0, 2000.0)
SQUARES_M = (400.0, 100.0, 25.0)
Rows = NDArray[np.float32]


TIME_FIELD = 13


def sample_city(photos: Sequence[Path], rows: Rows) -> list[PlaceSample]:
    """Sample a city's database photos, with coordinates and with label paths.

    Args:
        photos: The photos, with @UTM@ names.
        rows: (n, D) their descriptors.
    """
    names = [photo.name for photo in photos]
    captured_at = [
        datetime.strptime(name.split("@")[TIME_FIELD] + "Z", "%Y%m%d%H%M%S%z") for name in names
    ]
    located = [location for name in names if (location := parse_utm_file_name(name)) is not None]
    spots = [PhotoLocation(location.latitude, location.longitude, None) for location in located]
    paths = [PhotoLocation(None, None, _square_path(location)) for location in located]
    return [
        *sample_map(spots, captured_at, rows, labels_are_paths=False),
        *sample_map(paths, captured_at, rows, labels_are_paths=True),
    ]


def sample_map(
    locations: Sequence[PhotoLocation],
    captured_at: Sequence[datetime | None],
    rows: Rows,
    *,
    labels_are_paths: bool,
) -> list[PlaceSample]:
    """Sample all photos of a map whose descriptors are in memory."""
    scores = rows @ rows.T

    def rank(photo: int) -> IndexRanking:
        order = np.argsort(-scores[photo], kind="stable")
        order = order[order != photo]
        return order, scores[photo][order].astype(np.float64)

    scheme = LevelScheme(labels_are_paths=labels_are_paths, radii_m=RADII_M)
    sampler = OwnPhotoSampler(locations, captured_at, scheme, RADII_M[0], rank)
    photos = range(len(locations))
    return list(sampler.samples(photos, sampler.spread(photos)))


def fit_prior(samples: Sequence[PlaceSample]) -> PlacePrior:
    """Fit the prior on the samples of many maps; all levels have the same coefficients."""
    weights = sample_weights(samples, OUT_OF_MAP_SHARE)
    levels = RegressionTable.of_rows(
        (level.features, right, weight)
        for sample, weight in zip(samples, weights, strict=True)
        for level, right in zip(sample.levels, sample.is_right, strict=True)
        if right is not None
    )
    zeros = (0.0,) * (1 + len(FEATURES))
    scales = np.maximum(levels.features.std(axis=0), 1e-6)
    standard = PlacePrior(
        means=tuple(levels.features.mean(axis=0).round(4).tolist()),
        scales=tuple(scales.round(4).tolist()),
        level=zeros,
        not_in_map=zeros,
    )
    return standard.model_copy(
        update={
            "level": _rounded(fit_map_estimate(levels, zeros, standard)),
            "not_in_map": _rounded(fit_map_estimate(not_in_map_table(samples), zeros, standard)),
        }
    )


def main(folders: Sequence[Path]) -> None:
    """Describe and sample the cities, and write the prior."""
    samples: list[PlaceSample] = []
    for number, folder in enumerate(folders):
        city = open_evaluation_set(folder)
        photos = [photo.path for photo in city.database]
        sampled = sample_city(photos, _describe(city, photos))
        samples += sampled
        console.print(f"{folder.name} ({number + 1} of {len(folders)}): {len(sampled)} samples")
    PRIOR_FILE.write_text(fit_prior(samples).model_dump_json(indent=1) + "\n", encoding="utf-8")


def _describe(city: EvaluationSet, photos: Sequence[Path]) -> Rows:
    # Decoder processes import this module, and their memory limit leaves no room for torch.
    from services.cli.evaluation.describers import extractor_describer
    from shared.evaluation.ranking import describe_to_matrix

    settings = read_settings()
    extractor = settings.new_map_extractor
    with Progress() as progress:
        describer = extractor_describer(extractor, None, city, settings, progress, fit=True)
        with describe_to_matrix(describer.describe, photos) as rows:
            return np.array(rows)


def _square_path(location: FileNameLocation) -> str:
    return "/".join(
        f"{int(location.east // side)},{int(location.north // side)}" for side in SQUARES_M
    )


def _rounded(coefficients: Sequence[float]) -> tuple[float, ...]:
    return tuple(round(value, 4) for value in coefficients)


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
