"""Fits the prior of place models on generated cities and writes it to `prior.json`.

    placewise datasets synth CITY --no-train --seed 1 ...   (several cities)
    python -m lab.benchmarks.place_prior CITY [CITY ...]
    python -m lab.benchmarks.place_prior --elsewhere SET [SET ...]

With `--elsewhere`, only what photos of elsewhere score is fitted (`Elsewhere`): each set is a map,
and the photos of all others are queries from elsewhere. Own photos and queries of a map count as
much as all photos of elsewhere. The intercept is then raised until at most one in twenty photos of
each other set is said to be in a map. A table shows what passes of each set in each map with
coefficients that were fitted without both. No set may show places of another one.

Only coefficients are stored. Each city is described by the default extractor, with a vocabulary
fitted on it, and sampled once with its coordinates, and once with label paths, which are squares of
400 m and 100 m and the place. The samples are those of a live map (`places.samples`) and the
city's queries, which were taken in other weather and at night: the map's own photos do not show how
weak the evidence of a right answer can be.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    sample_weights,
)
from shared.evaluation.places.levels import FEATURES, CandidateLevel, FloatArray, LevelScheme
from shared.evaluation.places.probability import (
    ELSEWHERE_SHARE,
    PRIOR_FILE,
    UNMAPPED_SHARE,
    Coefficients,
    PlacePrior,
    shipped_prior,
)
from shared.geodesy import EARTH_RADIUS_M
from shared.matching.detectors import load_detector
from shared.matching.features import LocalFeatures
from shared.matching.matchers import MutualNearest

OWN, QUERIES = "own photos", "queries"
IN_MAP = {OWN, QUERIES}
MATCHED_PHOTOS = 45  # of each set, and twice as many of a map's own
MIN_PHOTOS = 20  # of a set, to say what one in twenty of it is
PASSING = log(0.05 / 0.95) - log(ELSEWHERE_SHARE / (1 - ELSEWHERE_SHARE))  # log-odds without prior
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
    trial = TrialMap(photos, photos.is_database)
    samples, spread = trial.own_samples()
    for query in np.flatnonzero(photos.is_query).tolist():
        sample = trial.query_sample(query, spread)
        samples.append(sample if trial.has_place(query) else replace(sample, left_out="outside"))
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


def elsewhere_levels(photos: DescribedPhotos) -> dict[str, list[Sequence[CandidateLevel]]]:
    """Return the levels of a map's own photos, of its queries, and of the photos of each set."""
    trial = TrialMap(photos, photos.is_database)
    most = MATCHED_PHOTOS if photos.match else FOREIGN_PHOTOS
    own = _thinned(range(len(trial.members)), 2 * most)
    spread = trial.own_photos.spread(own)
    samples = trial.own_photos.samples(own, spread, trial.match if photos.match else None)
    levels = {OWN: [s.levels for s in samples if s.left_out is None and not s.is_alone]}
    in_map = [q for q in np.flatnonzero(photos.is_query).tolist() if trial.has_place(q)]
    for name, numbers in {QUERIES: in_map, **photos.foreign}.items():
        levels[name] = [trial.query_sample(q, spread).levels for q in _thinned(numbers, most)]
    return levels


def _thinned(numbers: Sequence[int], most: int) -> Sequence[int]:
    """Return every n-th of them, at most `most`."""
    return numbers[:: -(-len(numbers) // most) or 1]


def fit_log_odds(maps: Iterable[Mapping[str, FloatArray]]) -> Coefficients:
    """Fit the log-odds of "elsewhere" on the features of the photos of each set, by map.

    A feature that is larger for photos of elsewhere gets no weight. The intercept is raised until
    at most one in twenty photos of each set passes.
    """
    rows = [
        (name not in IN_MAP, features, 1 / (2 if name in IN_MAP else len(each.keys() - IN_MAP)))
        for each in maps
        for name, features in each.items()
    ]
    width = rows[0][1].shape[1]
    used, slopes = np.ones(width, dtype=bool), np.ones(width)
    while (slopes > 0).any():
        table = RegressionTable.of_rows(
            (row * used, is_elsewhere, MAP_WEIGHT * share / len(features))
            for is_elsewhere, features, share in rows
            for row in features
        )
        plain = PlacePrior(means=(0.0,) * width, scales=(1.0,) * width, level=(), missing_place=())
        intercept, *fitted = fit_map_estimate(table, (0.0,) * (1 + width), plain, 0.01)
        slopes = np.array(fitted)
        used &= slopes <= 0
    # As in conformal prediction, one more photo, which passes, is counted.
    least = min(
        np.sort(intercept + features @ slopes)[max(0, (len(features) + 1) // 20 - 1)]
        for is_elsewhere, features, _ in rows
        if is_elsewhere and len(features) >= MIN_PHOTOS
    )
    return _rounded([intercept + max(0.0, PASSING + 0.001 - least), *slopes])


def _print_held_out(maps: Sequence[tuple[str, Mapping[str, FloatArray]]]) -> None:
    """Print what passes with coefficients that were fitted without the map and the set."""
    table = Table("map", "photos of", "number", "passing, %")
    for name, asked, features in ((name, k, v) for name, each in maps for k, v in each.items()):
        others = [
            {k: v for k, v in each.items() if k not in (name, asked) or k in IN_MAP}
            for other, each in maps
            if other not in (name, asked)
        ]
        intercept, *slopes = fit_log_odds(others)
        passing = intercept + features @ np.array(slopes) <= PASSING
        table.add_row(name, asked, str(len(passing)), f"{100 * passing.mean():.1f}")
    print_table(table)


def fit_elsewhere(folders: Sequence[Path]) -> None:
    """Write what photos of elsewhere score, with each of the sets that has places as a map."""
    prior, detector = shipped_prior(), load_detector("xfeat", torch.device("cpu"))
    matcher = MutualNearest.of_model(detector.model)

    @cache
    def features(path: Path) -> LocalFeatures:
        return detect_all(detector, [path], lambda: None)[0][0]

    def features_of(paths: Sequence[Path]) -> Callable[[int], LocalFeatures]:
        return lambda number: features(paths[number])

    found: dict[tuple[str, str], list[tuple[str, dict[str, FloatArray]]]] = {}
    with Progress(console=console) as progress:
        for photos in chain(*(describe_sets(folders, progress, own) for own in (True, False))):
            background = TrialMap(photos, photos.is_database).background
            matched = MatchedPhotos(features_of(photos.paths), matcher)
            kinds = {"coefficients": None, "matched": matched.match}
            for kind, match in list(kinds.items())[: 2 if photos.extractor else 1]:
                levels = elsewhere_levels(replace(photos, match=match))
                for extractor in {"", photos.extractor}:
                    unit = prior.elsewhere[extractor]
                    unit = unit.model_copy(update={"background": unit.background or background})
                    described = {
                        name: np.array([unit.features(one) for one in each if one])
                        for name, each in levels.items()
                        if any(each)
                    }
                    found.setdefault((extractor, kind), []).append((photos.name, described))
    elsewhere = dict(prior.elsewhere)
    for (extractor, kind), maps in found.items():
        console.print(f"{extractor or 'other extractors'}, {kind}")
        _print_held_out(maps)
        fitted = {kind: fit_log_odds([each for _, each in maps])}
        elsewhere[extractor] = elsewhere[extractor].model_copy(update=fitted)
    _write(prior.model_copy(update={"elsewhere": elsewhere}))


def main(folders: Sequence[Path]) -> None:
    """Describe and sample the cities, and write the prior."""
    samples: list[PlaceSample] = []
    with Progress(console=console) as progress:
        for city in describe_sets(folders, progress):
            samples += _sample_city(city)
            console.print(f"{city.name}: {len(samples)} samples so far")
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
