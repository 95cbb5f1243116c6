"""Fits the prior of place models and writes it to `prior.json`.

    python -m lab.benchmarks.place_prior SET [SET ...]
    python -m lab.benchmarks.place_prior --missing-place CITY [CITY ...]

Each set is a map that is described by the default extractor, with a vocabulary fitted on it, and
the photos of all others are queries from elsewhere. No set may show places of another one. Fitted
are, without and with matches,

- the levels, on the map's own photos and on its queries of other days, which count as much: own
  photos do not show how weak the evidence of a right answer can be;
- what photos of elsewhere score (`Elsewhere`). The intercept is raised by what the worst pair of
  a map and a set needs with coefficients that were fitted without both, so that at most one in
  twenty of its photos is said to be in the map. A table shows what passes of each pair then.

With `--missing-place`, the features are standardised and the log-odds of a missing place fitted, on
generated cities (`placewise datasets synth CITY --no-train --seed 1 ...`). Each is sampled once
with its coordinates, and once with label paths, which are squares of 400 m and 100 m and the place.

Only coefficients are stored.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import chain
from math import cos, log, radians
from pathlib import Path

import numpy as np
import torch
from rich.progress import Progress

from lab.benchmarks.estimates import FOREIGN_PHOTOS, DescribedPhotos, TrialMap, describe_sets
from lab.benchmarks.matches import MatchedPhotos, detect_all
from services.cli.output import Table, console, print_table
from shared.evaluation.places.evidence import PhotoLocation
from shared.evaluation.places.fit import (
    PlaceSample,
    RegressionTable,
    fit_map_estimate,
    missing_place_table,
)
from shared.evaluation.places.levels import FEATURES, FloatArray, LevelScheme
from shared.evaluation.places.probability import (
    ELSEWHERE_SHARE,
    PRIOR_FILE,
    Coefficients,
    Elsewhere,
    PlacePrior,
    shipped_prior,
)
from shared.geodesy import EARTH_RADIUS_M
from shared.matching.detectors import load_detector
from shared.matching.features import LocalFeatures
from shared.matching.matchers import MutualNearest

OWN, QUERIES = "own photos", "queries"
MATCHED_PHOTOS = 45  # of each set, and twice as many of a map's own
MIN_PHOTOS = 20  # of a set, to say what one in twenty of it is
PASSING = log(0.05 / 0.95) - log(ELSEWHERE_SHARE / (1 - ELSEWHERE_SHARE))  # log-odds without prior
SQUARES_M = (400.0, 100.0, 25.0)
MAP_WEIGHT = 300.0  # of a map's own photos and queries, and of all photos of elsewhere
PRECISION = 2.0  # of each coefficient of a level
MISSING_PRECISION = 50.0  # features that vary together would get large ones of both signs

MapSamples = Mapping[str, Sequence[PlaceSample]]
"""Samples of a map's own photos, of its queries, and of the photos of each other set."""
MapFeatures = tuple[str, Mapping[str, FloatArray]]
"""The name of a map, and for each of these the (n, F) features of `Elsewhere`."""


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
    trial = TrialMap(photos, photos.is_database)
    samples, spread = trial.own_samples()
    for query in np.flatnonzero(photos.is_query).tolist():
        sample = trial.query_sample(query, spread)
        samples.append(sample if trial.has_place(query) else replace(sample, left_out="outside"))
    return samples


def _fit_missing_place(samples: Sequence[PlaceSample]) -> PlacePrior:
    """Standardise the features of all levels, and fit the log-odds of a missing place."""
    features = np.array([level.features for sample in samples for level in sample.levels])
    standard = shipped_prior().model_copy(
        update={
            "means": tuple(features.mean(axis=0).round(4).tolist()),
            "scales": tuple(np.maximum(features.std(axis=0), 1e-6).round(4).tolist()),
        }
    )
    zeros = (0.0,) * (1 + len(FEATURES))
    missing = fit_map_estimate(missing_place_table(samples), zeros, standard, MISSING_PRECISION)
    return standard.model_copy(update={"missing_place": _rounded(missing)})


def map_samples(photos: DescribedPhotos) -> MapSamples:
    """Sample a map's own photos, its queries, and the photos of each other set."""
    trial = TrialMap(photos, photos.is_database)
    most = MATCHED_PHOTOS if photos.match else FOREIGN_PHOTOS
    own = _thinned(range(len(trial.members)), 2 * most)
    spread = trial.own_photos.spread(own)
    samples = trial.own_photos.samples(own, spread, trial.match if photos.match else None)
    found = {OWN: [s for s in samples if s.left_out is None and not s.is_alone]}
    in_map = [q for q in np.flatnonzero(photos.is_query).tolist() if trial.has_place(q)]
    for name, numbers in {QUERIES: in_map, **photos.foreign}.items():
        asked = (trial.query_sample(q, spread) for q in _thinned(numbers, most))
        found[name] = [sample for sample in asked if sample.levels]
    return found


def fit_levels(maps: Iterable[MapSamples]) -> Coefficients:
    """Fit the log-odds of a level, which are the same for all levels of all maps."""
    tables = (
        [
            (level.features, right)
            for sample in each[kind]
            for level, right in zip(sample.levels, sample.is_right, strict=True)
            if right is not None
        ]
        for each in maps
        for kind in (OWN, QUERIES)
    )
    table = RegressionTable.of_rows(
        (features, right, MAP_WEIGHT / 2 / len(rows)) for rows in tables for features, right in rows
    )
    zeros = (0.0,) * (1 + table.features.shape[1])
    return _rounded(fit_map_estimate(table, zeros, precision=PRECISION))


def _thinned(numbers: Sequence[int], most: int) -> Sequence[int]:
    """Return every n-th of them, at most `most`."""
    return numbers[:: -(-len(numbers) // most) or 1]


def fit_elsewhere(maps: Sequence[MapFeatures]) -> Coefficients:
    """Fit the log-odds of "elsewhere" on the features of the photos of each set, by map.

    The intercept is raised by what the worst pair needs (see the module).
    """
    intercept, *slopes = _fit_log_odds(each for _, each in maps)
    # As in conformal prediction, one more photo, which passes, is counted.
    least = [
        np.sort(log_odds)[max(0, (len(log_odds) + 1) // 20 - 1)]
        for _, asked, log_odds in held_out_log_odds(maps)
        if asked != QUERIES and len(log_odds) >= MIN_PHOTOS
    ]
    return _rounded([intercept + max(0.0, PASSING + 0.001 - min(least)), *slopes])


def held_out_log_odds(maps: Sequence[MapFeatures]) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield each map, each set, and the log-odds of its photos before the intercept is raised.

    The coefficients are fitted without both.
    """
    for name, asked, features in ((name, k, v) for name, each in maps for k, v in each.items()):
        intercept, *slopes = _fit_log_odds(
            {k: v for k, v in each.items() if k not in (name, asked) or k == QUERIES}
            for other, each in maps
            if other not in (name, asked)
        )
        yield name, asked, intercept + features @ np.array(slopes)


def _fit_log_odds(maps: Iterable[Mapping[str, FloatArray]]) -> Coefficients:
    """Fit the log-odds; a feature that is larger for photos of elsewhere gets no weight."""
    rows = [
        (name != QUERIES, features, 1.0 if name == QUERIES else 1 / (len(each) - 1))
        for each in maps
        for name, features in each.items()
    ]
    width = rows[0][1].shape[1]
    used, slopes = np.ones(width, dtype=bool), np.ones(width)
    fitted: Coefficients = ()
    while (slopes > 0).any():
        table = RegressionTable.of_rows(
            (row * used, is_elsewhere, MAP_WEIGHT * share / len(features))
            for is_elsewhere, features, share in rows
            for row in features
        )
        plain = PlacePrior(means=(0.0,) * width, scales=(1.0,) * width, level=(), missing_place=())
        fitted = fit_map_estimate(table, (0.0,) * (1 + width), plain, 0.01)
        slopes = np.array(fitted[1:])
        used &= slopes <= 0
    return fitted


def main(folders: Sequence[Path]) -> None:
    """Fit the levels and what photos of elsewhere score; each set that has places is a map."""
    prior, detector = shipped_prior(), load_detector("xfeat", torch.device("cpu"))
    matcher = MutualNearest.of_model(detector.model)

    @cache
    def features(path: Path) -> LocalFeatures:
        return detect_all(detector, [path], lambda: None)[0][0]

    def features_of(paths: Sequence[Path]) -> Callable[[int], LocalFeatures]:
        return lambda number: features(paths[number])

    found: dict[tuple[str, str], list[MapFeatures]] = {}
    levels: dict[str, list[MapSamples]] = {"level": [], "matched": []}
    with Progress(console=console) as progress:
        for photos in chain(*(describe_sets(folders, progress, own) for own in (True, False))):
            background = TrialMap(photos, photos.is_database).background
            matched = MatchedPhotos(features_of(photos.paths), matcher)
            kinds = {"coefficients": None, "matched": matched.match}
            for kind, match in list(kinds.items())[: 2 if photos.extractor else 1]:
                samples = map_samples(replace(photos, match=match))
                if photos.extractor:
                    levels["matched" if match else "level"].append(samples)
                for extractor in {"", photos.extractor}:
                    unit = prior.elsewhere[extractor]
                    unit = unit.model_copy(update={"background": unit.background or background})
                    described = describe_elsewhere(unit, samples)
                    found.setdefault((extractor, kind), []).append((photos.name, described))
    elsewhere = dict(prior.elsewhere)
    for (extractor, kind), maps in found.items():
        fitted = fit_elsewhere(maps)
        elsewhere[extractor] = elsewhere[extractor].model_copy(update={kind: fitted})
        raised = fitted[0] - _fit_log_odds(each for _, each in maps)[0]
        table = Table("map", "photos of", "number", "passing, %", title=f"{extractor} {kind}")
        for name, asked, log_odds in held_out_log_odds(maps):
            passing = f"{100 * np.mean(log_odds + raised <= PASSING):.1f}"
            table.add_row(name, asked, str(len(log_odds)), passing)
        print_table(table)
    fits = {name: fit_levels(each) for name, each in levels.items()}
    _write(prior.model_copy(update={"elsewhere": elsewhere, **fits}))


def describe_elsewhere(unit: Elsewhere, samples: MapSamples) -> dict[str, FloatArray]:
    """Return the (n, F) features of `Elsewhere` of the queries and the other sets of a map.

    Its own photos are left out: so similar are few queries of another day.
    """
    return {
        name: np.array([unit.features(sample.levels) for sample in each])
        for name, each in samples.items()
        if each and name != OWN
    }


def fit_missing_place(folders: Sequence[Path]) -> None:
    """Describe and sample the cities, and write the log-odds of a missing place."""
    samples: list[PlaceSample] = []
    with Progress(console=console) as progress:
        for city in describe_sets(folders, progress):
            samples += _sample_city(city)
            console.print(f"{city.name}: {len(samples)} samples so far")
    _write(_fit_missing_place(samples))


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
    arguments = [Path(argument) for argument in sys.argv[1:] if argument != "--missing-place"]
    fit_missing_place(arguments) if "--missing-place" in sys.argv else main(arguments)
