"""Fits the prior of place models on generated cities and writes it to `prior.json`.

    placewise datasets synth CITY --no-train --seed 1 ...   (several cities)
    python -m lab.benchmarks.place_prior CITY [CITY ...]
    python -m lab.benchmarks.place_prior --elsewhere SET [SET ...]

With `--elsewhere`, only what photos of elsewhere score is fitted (`Elsewhere`): each set is a map,
and the photos of all others are queries from elsewhere. Own photos and queries of a map count as
much as all photos of elsewhere. The intercept is then raised until at most one in twenty photos of
each other set is said to be in a map. The coefficients with matches stay as they are.

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
from math import cos, log, radians
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
    missing_place_table,
    sample_weights,
)
from shared.evaluation.places.levels import FEATURES, FloatArray, LevelScheme, candidate_levels
from shared.evaluation.places.probability import (
    ELSEWHERE_SHARE,
    PRIOR_FILE,
    UNMAPPED_SHARE,
    Elsewhere,
    PlacePrior,
    shipped_prior,
)
from shared.geodesy import EARTH_RADIUS_M

SQUARES_M = (400.0, 100.0, 25.0)
MAP_WEIGHT = 300.0  # of a map's own photos and queries, and of all photos of elsewhere
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
    weights = sample_weights(samples, UNMAPPED_SHARE)
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
        missing_place=zeros,
    )
    return standard.model_copy(
        update={
            "level": _rounded(fit_map_estimate(levels, zeros, standard, PRECISION)),
            "missing_place": _rounded(
                fit_map_estimate(missing_place_table(samples), zeros, standard, PRECISION)
            ),
        }
    )


def _elsewhere_rows(photos: DescribedPhotos, unit: Elsewhere) -> dict[str, FloatArray]:
    """Return the (n, 2) features of a map's own photos, its queries, and each other set."""
    trial = TrialMap(photos, ~photos.is_query)
    unit = unit if unit.background else unit.model_copy(update={"background": trial.background})
    samples, spread = trial.own_samples()
    own = [s.levels for s in samples if s.left_out is None and not s.is_alone]
    queries = [
        trial.query_sample(q, spread).levels for q in np.flatnonzero(photos.is_query).tolist()
    ]
    rows = {"": own, "queries": queries}
    for name, foreign in photos.foreign.items():
        found = (trial.search(row) for row in foreign)
        rows[name] = [
            candidate_levels(*each, photos.scheme, spread, photos.radius_m) for each in found
        ]
    return {k: np.array([unit.features(v) for v in each if v]) for k, each in rows.items() if each}


def _fit_elsewhere(maps: Sequence[dict[str, FloatArray]], unit: Elsewhere) -> Elsewhere:
    """Fit the log-odds of "elsewhere" on the features of several maps."""
    table = RegressionTable.of_rows(
        (row, name not in ("", "queries"), MAP_WEIGHT / len(rows) / share)
        for each in maps
        for name, rows in each.items()
        for share in [2 if name in ("", "queries") else len(each) - 2]
        for row in rows
    )
    plain = PlacePrior(means=(0.0, 0.0), scales=(1.0, 1.0), level=(), missing_place=())
    intercept, *slopes = fit_map_estimate(table, (0.0,) * 3, plain, 0.01)
    least = log(0.05 / 0.95) - log(ELSEWHERE_SHARE / (1 - ELSEWHERE_SHARE))
    passing = [
        float(np.quantile(intercept + rows @ np.array(slopes), 0.05))
        for each in maps
        for name, rows in each.items()
        if name not in ("", "queries")
    ]
    raised = intercept + max(0.0, least - min(passing))
    return unit.model_copy(update={"coefficients": _rounded([raised, *slopes])})


def fit_elsewhere(folders: Sequence[Path]) -> None:
    """Write what photos of elsewhere score, with each of the sets as a map."""
    prior = shipped_prior()
    with Progress(console=console) as progress:
        maps = [describe_set(f, progress, [o for o in folders if o != f]) for f in folders]
    fitted = {
        name: _fit_elsewhere([_elsewhere_rows(each, unit) for each in maps], unit)
        for name, unit in prior.elsewhere.items()
    }
    _write(prior.model_copy(update={"elsewhere": fitted}))


def main(folders: Sequence[Path]) -> None:
    """Describe and sample the cities, and write the prior."""
    samples: list[PlaceSample] = []
    with Progress(console=console) as progress:
        for folder in folders:
            samples += _sample_city(describe_set(folder, progress))
            console.print(f"{folder.name}: {len(samples)} samples so far")
    elsewhere = shipped_prior().elsewhere
    _write(_fit_prior(samples).model_copy(update={"elsewhere": elsewhere}))


def _write(prior: PlacePrior) -> None:
    PRIOR_FILE.write_text(prior.model_dump_json(indent=1) + "\n", encoding="utf-8")


def _square_path(spot: PhotoLocation) -> str:
    if spot.latitude is None or spot.longitude is None:
        raise ValueError("the photos of a city have coordinates")
    north_m = EARTH_RADIUS_M * radians(spot.latitude)
    east_m = EARTH_RADIUS_M * radians(spot.longitude) * cos(radians(round(spot.latitude, 1)))
    return "/".join(f"{east_m // side:.0f},{north_m // side:.0f}" for side in SQUARES_M)


def _rounded(coefficients: Sequence[float]) -> tuple[float, ...]:
    return tuple(round(value, 4) for value in coefficients)


if __name__ == "__main__":
    arguments = [Path(argument) for argument in sys.argv[1:] if argument != "--elsewhere"]
    fit_elsewhere(arguments) if "--elsewhere" in sys.argv else main(arguments)
