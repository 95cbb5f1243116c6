"""Fits the prior of place models on generated cities and writes it to `prior.json`.

    placewise datasets synth CITY --no-train --seed 1 ...   (several cities)
    python -m lab.benchmarks.place_prior CITY [CITY ...]

Only coefficients are stored. Each city is described by the default extractor, with a vocabulary
fitted on it, and sampled once with its coordinates, and once with label paths, which are squares of
400 m and 100 m and the place. The samples are those of a live map (`places.samples`) and the
city's queries, which were taken in other weather and at night: the map's own photos do not show how
weak the evidence of a right answer can be.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from math import cos, radians
from pathlib import Path

import numpy as np
from rich.progress import Progress

from lab.benchmarks.estimates import DescribedPhotos, TrialMap, describe_set
from services.cli.output import console
from shared.evaluation.places.evidence import PhotoLocation, is_same_place
from shared.evaluation.places.fit import (
    PlaceSample,
    RegressionTable,
    fit_map_estimate,
    not_in_map_table,
    sample_weights,
)
from shared.evaluation.places.levels import FEATURES, LevelScheme
from shared.evaluation.places.probability import OUT_OF_MAP_SHARE, PRIOR_FILE, PlacePrior
from shared.geodesy import EARTH_RADIUS_M

SQUARES_M = (400.0, 100.0, 25.0)
PRECISION = 50.0  # without it, features that vary together get large coefficients of both signs


def _sample_city(city: DescribedPhotos) -> list[PlaceSample]:
    """Sample a city with coordinates and with label paths."""
    paths = replace(
        city,
        locations=[PhotoLocation(None, None, _square_path(spot)) for spot in city.locations],
        scheme=LevelScheme(labels_are_paths=True, radii_m=city.scheme.radii_m),
    )
    return [*_sample_map(city), *_sample_map(paths)]


def _sample_map(photos: DescribedPhotos) -> list[PlaceSample]:
    """Sample the database photos and the queries of a city."""
    trial = TrialMap(photos, ~photos.is_query)
    samples, spread = trial.own_samples()
    for query in np.flatnonzero(photos.is_query).tolist():
        truth = photos.locations[query]
        in_map = any(is_same_place(truth, spot, photos.radius_m) for spot in trial.locations)
        sample = trial.query_sample(query, spread)
        samples.append(sample if in_map else replace(sample, left_out="outside"))
    return samples


def _fit_prior(samples: Sequence[PlaceSample]) -> PlacePrior:
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
            "level": _rounded(fit_map_estimate(levels, zeros, standard, PRECISION)),
            "not_in_map": _rounded(
                fit_map_estimate(not_in_map_table(samples), zeros, standard, PRECISION)
            ),
        }
    )


def main(folders: Sequence[Path]) -> None:
    """Describe and sample the cities, and write the prior."""
    samples: list[PlaceSample] = []
    with Progress(console=console) as progress:
        for folder in folders:
            samples += _sample_city(describe_set(folder, progress))
            console.print(f"{folder.name}: {len(samples)} samples so far")
    PRIOR_FILE.write_text(_fit_prior(samples).model_dump_json(indent=1) + "\n", encoding="utf-8")


def _square_path(spot: PhotoLocation) -> str:
    if spot.latitude is None or spot.longitude is None:
        raise ValueError("the photos of a city have coordinates")
    north_m = EARTH_RADIUS_M * radians(spot.latitude)
    east_m = EARTH_RADIUS_M * radians(spot.longitude) * cos(radians(round(spot.latitude, 1)))
    return "/".join(f"{east_m // side:.0f},{north_m // side:.0f}" for side in SQUARES_M)


def _rounded(coefficients: Sequence[float]) -> tuple[float, ...]:
    return tuple(round(value, 4) for value in coefficients)


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
