"""Probabilities of the levels on a data set: fitted on database photos, measured on queries.

The place model is fitted as that of a live map is, on the map's own photos only, so that the
queries measure what a new map answers before it has labelled queries.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.datasets.utm_coordinates import parse_utm_grid, utm_to_degrees
from lab.evaluation.exact_knn import Rankings, Rows, exact_knn
from shared.evaluation.places.evidence import (
    DIFFERENT_PLACE_M,
    EVIDENCE_DEPTH,
    PhotoLocation,
    RankedPhoto,
    is_same_place,
)
from shared.evaluation.places.figures import (
    REPORTED_CERTAINTIES,
    answer_figures,
    reliability_figures,
)
from shared.evaluation.places.fit import MapScores, fit_place_model
from shared.evaluation.places.levels import LevelScheme, candidate_levels
from shared.evaluation.places.probability import Background, MapExtent
from shared.evaluation.places.samples import IndexRanking, MatchOwnPhoto, OwnPhotoSampler
from shared.evaluation.places.thresholds import HeldOutEstimate

SAMPLED_PHOTOS = 1000
"""Database photos that the model is fitted on; as many as an evaluation of a live map draws"""
RANKS = 800  # depth of the search for other places where hundreds of photos show the same one
SEED = 0
RANDOM_PAIRS = 4000
MATCHED_PAIRS = 100


class _RowRanker:
    """Ranks database photos by their similarity to one of them; searches many at once."""

    def __init__(self, rows: Rows) -> None:
        self._rows = rows
        self._rankings: dict[int, IndexRanking] = {}
        self._requested: set[int] = set()

    def __call__(self, photo: int) -> IndexRanking | None:
        if photo not in self._rankings:
            self._requested.add(photo)
        return self._rankings.get(photo)

    def search_requested(self) -> bool:
        """Search all photos that had no ranking when they were requested; False if none."""
        photos = sorted(self._requested)
        self._requested.clear()
        if photos:
            found = exact_knn(self._rows[photos], self._rows, RANKS + 1)
            for photo, indices, scores in zip(photos, found.indices, found.scores, strict=True):
                others = indices != photo
                self._rankings[photo] = indices[others], scores[others].astype(np.float64)
        return bool(photos)


def measure_places(
    evaluation_set: EvaluationSet,
    database: Rows,
    ranked: Rankings,
    scheme: LevelScheme,
    position_radius_m: float,
    *,
    sampled_photos: int = SAMPLED_PHOTOS,
) -> dict[str, Any] | None:
    """Fit the place model on `sampled_photos` database photos at most, and measure its answers.

    `database` are the (m, D) float32 unit descriptors, `ranked` the database photos by query, best
    first, `EVIDENCE_DEPTH` of them if there are as many; `position_radius_m` is that of a place.

    Returns:
        `source` of the model, number of `own_photos` and of queries (`samples`), `answers` at each
        certainty (`answer_figures`) and reliability of the `levels` (`reliability_figures`).
        `outside_at_finest_level` is the share of the queries without positives that are answered at
        the finest level. None if no query has an estimate and a known location.
    """
    locations = [_photo_location(photo) for photo in evaluation_set.database]
    known = np.flatnonzero([location.is_known for location in locations])
    size = min(sampled_photos, len(known))
    sample = np.sort(np.random.default_rng(SEED).choice(known, size, replace=False)).tolist()
    captured_at = [photo.captured_at for photo in evaluation_set.database]
    best = [
        next((index for index in indices if locations[index].is_known), indices[0])
        for indices in ranked.indices[:, :EVIDENCE_DEPTH].tolist()
    ]
    ranker = _RowRanker(database)
    while True:
        own_photos = OwnPhotoSampler(locations, captured_at, scheme, position_radius_m, ranker)
        spread = own_photos.spread(sample)
        samples = list(own_photos.samples(sample, spread))
        neighbours = {photo: own_photos.neighbours(photo) for photo in set(best)}
        if not ranker.search_requested():
            break
    scores = MapScores(spread, measure_background(database), MapExtent.of(locations, scheme))
    model = fit_place_model(samples, (), scheme, scores).model
    estimates, outside = [], []
    for number, query in enumerate(evaluation_set.queries):
        truth = _photo_location(query)
        indices, scores = (
            each[number, :EVIDENCE_DEPTH].tolist() for each in (ranked.indices, ranked.scores)
        )
        ranking = [
            RankedPhoto(score, locations[index], index)
            for index, score in zip(indices, scores, strict=True)
            if locations[index].is_known
        ]
        unit, around = model.unit(ranking), neighbours[best[number]]
        levels = candidate_levels(ranking, around, scheme, unit, position_radius_m)
        if not levels or not truth.is_known:
            continue
        in_map = bool(len(evaluation_set.positives[number]))
        levels = model.extent.end_levels(levels)
        right = [*(level.is_right(truth) for level in levels[:-1]), in_map]
        estimates.append(HeldOutEstimate(*model.probabilities(levels), right, None, 1.0))
        if not in_map:
            outside.append(estimates[-1])
    if not estimates:
        return None
    positions = range(max(len(estimate.probabilities) for estimate in estimates))
    return {
        "source": model.source,
        "own_photos": model.own_photos,
        "samples": len(estimates),
        "answers": [
            {
                **answer_figures(model, estimates, certainty),
                "outside_at_finest_level": answer_figures(model, outside, certainty)[
                    "answered_at_finest_level"
                ]["mean"],
            }
            for certainty in REPORTED_CERTAINTIES
        ],
        "levels": [reliability_figures(estimates, position) for position in positions],
    }


def measure_background(
    rows: Rows, locations: Sequence[PhotoLocation] = (), match: MatchOwnPhoto | None = None
) -> Background:
    """Return what random pairs of (n, D) unit descriptors score.

    And with `match`, how well photos of different locations match.
    """
    pairs = np.random.default_rng(SEED).integers(len(rows), size=(RANDOM_PAIRS, 2))
    first, second = (pairs := pairs[pairs[:, 0] != pairs[:, 1]]).T
    supports = [
        match(photo, [other])[0]
        for photo, other in (pairs[:MATCHED_PAIRS].tolist() if match else [])
        if match and not is_same_place(locations[photo], locations[other], DIFFERENT_PLACE_M)
    ]
    scores = np.einsum("nd,nd->n", rows[first], rows[second]).tolist()
    return Background.of(scores, [each for each in supports if each is not None])


def _photo_location(photo: DatasetPhoto) -> PhotoLocation:
    latitude, longitude = photo.latitude, photo.longitude
    if latitude is None and None not in (photo.easting, photo.northing, photo.zone):
        grid = parse_utm_grid(str(photo.zone), photo.name)
        metres = np.array([photo.easting, photo.northing], dtype=np.float64)
        latitude, longitude = utm_to_degrees(grid, metres)
    return PhotoLocation(latitude, longitude, photo.place)
