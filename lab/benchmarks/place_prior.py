"""Fits the prior of place models and writes it to `prior.json`.

    python -m lab.benchmarks.place_prior SET [SET ...]
    python -m lab.benchmarks.place_prior --missing-place CITY [CITY ...]

Each set is a map that is described by the default extractor, with a vocabulary fitted on it, and
the photos of all others are queries from elsewhere. No set may show places of another one. Fitted
are, without and with matches,

- the levels, on the map's own photos and on its queries of other days, which count as much: own
  photos do not show how weak the evidence of a right answer can be;
- what photos of elsewhere score (`Elsewhere`). At most one in twenty photos of a set may be said to
  be in a map, also in the worst pair of both, with coefficients that were fitted without them. For
  that, all log-odds are taken nearer to even chances.

With `--missing-place`, the features are standardised and the log-odds of a missing place fitted, on
generated cities (`placewise datasets synth CITY --no-train --seed 1 ...`). Each is sampled once
with its coordinates, and once with label paths, which are squares of 400 m and 100 m and the place.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from math import cos, log, radians
from pathlib import Path

import numpy as np
import torch
from rich.progress import Progress

from lab.benchmarks.estimates import FOREIGN_PHOTOS, DescribedPhotos, TrialMap, describe_sets
from lab.benchmarks.matches import MatchedPhotos, detect_all
from services.cli.output import console
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
    PlacePrior,
    shipped_prior,
)
from shared.geodesy import EARTH_RADIUS_M
from shared.matching.features import LocalFeatures
from shared.matching.xfeat import load_detector

OWN, QUERIES = "own photos", "queries"
MATCHED_PHOTOS = 45  # of each set, and twice as many of a map's own
MIN_PHOTOS = 20  # of a set, to say what one in twenty of it is
EVEN = -log(ELSEWHERE_SHARE / (1 - ELSEWHERE_SHARE))  # log-odds without prior of even chances
PASSING = EVEN + log(0.05 / 0.95)
SQUARES_M = (400.0, 100.0, 25.0)
MAP_WEIGHT = 300.0  # of a map's own photos and queries, and of all photos of elsewhere
PRECISION = 2.0  # of each coefficient of a level
MISSING_PRECISION = 50.0  # features that vary together would get large ones of both signs

MapSamples = Mapping[str, Sequence[PlaceSample]]  # of OWN, QUERIES, and each other set


def _sample_city(city: DescribedPhotos) -> Iterator[PlaceSample]:
    """Sample the photos and the queries of a city, with coordinates and with label paths."""
    paths = replace(
        city,
        locations=[PhotoLocation(None, None, _square_path(spot)) for spot in city.locations],
        scheme=LevelScheme(labels_are_paths=True, radii_m=city.scheme.radii_m),
    )
    for photos in (city, paths):
        trial = TrialMap(photos, photos.is_database)
        samples, spread = trial.own_samples()
        yield from samples
        for query in np.flatnonzero(photos.is_query).tolist():
            sample = trial.query_sample(query, spread)
            yield sample if trial.has_place(query) else replace(sample, left_out="outside")


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
        queries = (trial.query_sample(q, spread) for q in _thinned(numbers, most))
        found[name] = [sample for sample in queries if sample.levels]
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
    return numbers[:: -(-len(numbers) // most) or 1]


def fit_elsewhere(maps: Sequence[tuple[str, Mapping[str, FloatArray]]]) -> Coefficients:
    """Fit the log-odds of "elsewhere" on the (n, F) features of the photos of each set, by map.

    They are taken as near to even chances as the worst pair needs, which is printed.
    """
    intercept, *slopes = _fit_log_odds(each for _, each in maps)
    worst = (PASSING, "no pair")
    for name, foreign, features in ((name, k, v) for name, each in maps for k, v in each.items()):
        if foreign == QUERIES or len(features) < MIN_PHOTOS:
            continue
        held_out = _fit_log_odds(
            {k: v for k, v in each.items() if k not in (name, foreign)}
            for other, each in maps
            if other not in (name, foreign)
        )
        log_odds = np.sort(held_out[0] + features @ np.array(held_out[1:]))
        # As in conformal prediction, one more photo, which passes, is counted.
        least = log_odds[max(0, (len(log_odds) + 1) // 20 - 1)]
        worst = min(worst, (float(least - 0.001), f"{foreign} in {name}"))
    console.print(f"{worst[1]}: one in twenty photos is below {worst[0]:.3f}")
    nearer = (PASSING - EVEN) / (worst[0] - EVEN)
    return _rounded([EVEN + nearer * (intercept - EVEN), *(nearer * slope for slope in slopes)])


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
        plain = PlacePrior(means=(), scales=(), level=(), missing_place=())
        fitted = fit_map_estimate(table, (0.0,) * (1 + width), plain, 0.01)
        slopes = np.array(fitted[1:])
        used &= slopes <= 0
    return fitted


def main(folders: Sequence[Path]) -> None:
    """Fit the levels and what photos of elsewhere score; each set that has places is a map."""
    prior, detector = shipped_prior(), load_detector(torch.device("cpu"))

    @cache
    def features(path: Path) -> LocalFeatures:
        return detect_all(detector, [path], lambda: None)[0][0]

    found: dict[tuple[str, str], list[tuple[str, Mapping[str, FloatArray]]]] = {}
    levels: dict[str, list[MapSamples]] = {"level": [], "matched": []}
    with Progress(console=console) as progress:
        for photos in chain(*(describe_sets(folders, progress, own) for own in (True, False))):
            background = TrialMap(photos, photos.is_database).background
            matched = MatchedPhotos(partial(lambda paths, n: features(paths[n]), photos.paths))
            kinds = {"coefficients": None, "matched": matched.match}
            for kind, match in list(kinds.items())[: 2 if photos.extractor else 1]:
                samples = map_samples(replace(photos, match=match))
                if photos.extractor:
                    levels["matched" if match else "level"].append(samples)
                for extractor in {"", photos.extractor}:
                    unit = prior.elsewhere[extractor]
                    unit = unit.model_copy(update={"background": unit.background or background})
                    # Few queries of another day are as similar as the map's own photos.
                    described = {
                        name: np.array([unit.features(sample.levels) for sample in each])
                        for name, each in samples.items()
                        if each and name != OWN
                    }
                    found.setdefault((extractor, kind), []).append((photos.name, described))
    elsewhere = dict(prior.elsewhere)
    for (extractor, kind), maps in found.items():
        update = {kind: fit_elsewhere(maps)}
        elsewhere[extractor] = elsewhere[extractor].model_copy(update=update)
    fits = {name: fit_levels(each) for name, each in levels.items()}
    _write(prior.model_copy(update=fits | {"elsewhere": elsewhere}))


def fit_missing_place(folders: Sequence[Path]) -> None:
    """Standardise the features of all levels of cities, and fit the log-odds of a missing place."""
    with Progress(console=console) as progress:
        samples = list(chain(*(_sample_city(city) for city in describe_sets(folders, progress))))
    features = np.array([level.features for sample in samples for level in sample.levels])
    standard = shipped_prior().model_copy(
        update={
            "means": tuple(features.mean(axis=0).round(4).tolist()),
            "scales": tuple(np.maximum(features.std(axis=0), 1e-6).round(4).tolist()),
        }
    )
    zeros = (0.0,) * (1 + len(FEATURES))
    missing = fit_map_estimate(missing_place_table(samples), zeros, standard, MISSING_PRECISION)
    _write(standard.model_copy(update={"missing_place": _rounded(missing)}))


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
