"""Levels of a place estimate: the places that a ranking points to, from the finest to the coarsest.

The levels of a *label path* such as `tower/floor 7/elevator` are its prefixes. The levels of
coordinates are circles of increasing radius around the estimated position. Each level has features
that say how clearly the ranking points to it; a model (`place_probability`) turns them into a
probability.

The features compare scores in units of the `spread` of a map's rankings, the median difference
between the first score and the last of `EVIDENCE_DEPTH`, so that extractors are comparable. Some of
them compare the query with the *neighbours* of the best photo, the photos of the map that are most
similar to it: a query that is less similar to it than many of its neighbours are was probably taken
elsewhere (local density, as in the local outlier factor of Breunig et al. 2000).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from shared.evaluation.place_evidence import (
    VOTING_PHOTOS,
    PhotoLocation,
    RankedPhoto,
    distance_between_m,
    estimate_location,
)
from shared.geodesy import distances_m

PATH_SEPARATOR = "/"
VOTE_TEMPERATURE = 0.1  # of the softmax over scores, in units of the spread
WIDE_TEMPERATURE = 0.3
MIN_SHARE = 1e-3  # of the votes; bounds the log-odds of a level that has all votes or none
MIN_SPREAD = 1e-6

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]


def label_levels(label: str | None, is_path: bool) -> tuple[str, ...]:
    """Return the levels of a place label, finest first.

    Args:
        label: The label, or None.
        is_path: Whether `/` separates levels. Otherwise the whole label is the only level.

    Returns:
        The prefixes of the path that end in a level with a name: those of `a//b` are `a//b` and
        `a`. Empty for None and for a path without any name.
    """
    if label is None or not is_path:
        return () if label is None else (label,)
    parts = label.split(PATH_SEPARATOR)
    return tuple(
        PATH_SEPARATOR.join(parts[:depth])
        for depth in range(len(parts), 0, -1)
        if parts[depth - 1].strip()
    )


def is_within_level(label: str | None, level: str) -> bool:
    """Return whether a label path is the level or lies below it."""
    return label is not None and (label == level or label.startswith(level + PATH_SEPARATOR))


class LevelScheme(BaseModel):
    """What the levels of a map are."""

    model_config = ConfigDict(frozen=True)

    labels_are_paths: bool
    radii_m: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class CandidateLevel:
    """A level of an estimate: a place, or a circle around the estimated position."""

    features: FloatArray
    """(len(FEATURES),)"""
    inside: Mask
    """(k,) which photos of the ranking lie in it"""
    place: str | None = None
    radius_m: float | None = None
    latitude: float | None = None
    longitude: float | None = None

    def is_right(self, truth: PhotoLocation, scheme: LevelScheme) -> bool | None:
        """Return whether the level contains the true location; None if the truth does not say.

        A label that ends above the level (`tower/floor 7` for `tower/floor 7/elevator`) does not
        say.
        """
        if self.radius_m is not None:
            distance = distance_between_m(PhotoLocation(self.latitude, self.longitude, None), truth)
            return None if distance is None else distance <= self.radius_m
        levels = label_levels(truth.place, scheme.labels_are_paths)
        if not levels or self.place is None:
            return None
        if self.place in levels:
            return True
        ends_above = scheme.labels_are_paths and is_within_level(self.place, levels[0])
        return None if ends_above else False


def candidate_levels(
    ranking: Sequence[RankedPhoto],
    neighbours: Sequence[RankedPhoto],
    scheme: LevelScheme,
    spread: float,
    position_radius_m: float,
) -> list[CandidateLevel]:
    """Find the levels that a ranking points to, with their features.

    The levels are those of labels if the labels are paths or no photo that counts has coordinates,
    and otherwise circles.

    Args:
        ranking: The first photos of the map, best first.
        neighbours: The ranking of the best photo itself, without it; empty if it is not known.
        scheme: The levels of the map.
        spread: Unit of score differences.
        position_radius_m: Photos within this distance of the best one determine the position.

    Returns:
        The levels, finest first; empty if the ranking has no location.
    """
    if not ranking:
        return []
    scores = _scores(ranking)
    if not scheme.labels_are_paths and ranking[0].location.latitude is not None:
        center = estimate_location(ranking, position_radius_m)
        return _circles(ranking, neighbours, scores, center, scheme.radii_m, spread)
    return _places(ranking, neighbours, scores, scheme.labels_are_paths, spread)


def _circles(
    ranking: Sequence[RankedPhoto],
    neighbours: Sequence[RankedPhoto],
    scores: FloatArray,
    center: PhotoLocation,
    radii_m: Sequence[float],
    spread: float,
) -> list[CandidateLevel]:
    away = _distances_m(center, ranking)
    neighbours_away = _distances_m(center, neighbours)
    neighbour_scores = _scores(neighbours)
    return [
        CandidateLevel(
            level_features(
                scores, away <= radius, neighbour_scores, neighbours_away <= radius, spread
            ),
            away <= radius,
            radius_m=radius,
            latitude=center.latitude,
            longitude=center.longitude,
        )
        for radius in sorted(radii_m)
    ]


def _places(
    ranking: Sequence[RankedPhoto],
    neighbours: Sequence[RankedPhoto],
    scores: FloatArray,
    is_path: bool,
    spread: float,
) -> list[CandidateLevel]:
    """Choose a place at each level, from the coarsest, by the votes inside the one chosen before.

    A photo votes with the weight exp(score / (VOTE_TEMPERATURE * spread)); a photo without a label
    has no vote. Where the photos whose labels end at a level have most of its votes, the estimate
    ends there, too.
    """
    paths = [label_levels(r.location.place, is_path)[::-1] for r in ranking]
    neighbour_paths = [label_levels(r.location.place, is_path)[::-1] for r in neighbours]
    neighbour_scores = _scores(neighbours)
    votes = _votes(scores, VOTE_TEMPERATURE * spread)
    inside = np.ones(len(ranking), dtype=bool)
    chosen: list[CandidateLevel] = []
    while True:
        depth = len(chosen)
        counts: dict[str, float] = {}
        ended = 0.0
        for index in np.flatnonzero(inside).tolist():
            if depth < len(paths[index]):
                place = paths[index][depth]
                counts[place] = counts.get(place, 0.0) + float(votes[index])
            elif depth > 0:
                ended += float(votes[index])
        if not counts or max(counts.values()) < ended:
            return chosen[::-1]
        best = max(counts, key=lambda place: counts[place])
        inside = _at_depth(paths, depth, best)
        features = level_features(
            scores, inside, neighbour_scores, _at_depth(neighbour_paths, depth, best), spread
        )
        chosen.append(CandidateLevel(features, inside, place=best))


FEATURES = (
    "votes",
    "wide_votes",
    "margin",
    "agreement_3",
    "agreement_10",
    "agreement",
    "support",
    "run",
    "lead",
    "ahead_of_neighbours_outside",
    "ahead_of_neighbours_inside",
    "nearer_neighbours",
    "ahead_of_neighbours",
)
"""Names of a level's features, in the order of `level_features`."""


def level_features(
    scores: FloatArray,
    inside: Mask,
    neighbour_scores: FloatArray,
    neighbours_inside: Mask,
    spread: float,
) -> FloatArray:
    """Compute the features of a level.

    Args:
        scores: (k,) scores of the ranking, highest first.
        inside: (k,) which of its photos lie in the level.
        neighbour_scores: (n,) scores of the best photo's own ranking.
        neighbours_inside: (n,) which of these photos lie in the level.
        spread: Unit of score differences.

    Returns:
        (len(FEATURES),) float64: log-odds of the votes inside, at two temperatures; margin of the
        best score inside over the best outside; share of the first 3, the first 10 and all photos
        that lie inside; log of the summed margins of the first ten inside; log of the number of
        leading photos inside; first score minus last. Then the first score minus the best of a
        neighbour outside, and inside; log of the number of neighbours that are more similar to the
        best photo than the query is; and the first score minus the mean of the first ten
        neighbours. The last four are 0 without neighbours.
    """
    last = scores[-1]
    best_outside = scores[~inside].max(initial=last)
    support = np.maximum(0.0, scores[:VOTING_PHOTOS][inside[:VOTING_PHOTOS]] - best_outside).sum()
    run = len(inside) if inside.all() else int(inside.argmin())
    features = [
        _log_odds(_votes(scores, VOTE_TEMPERATURE * spread), inside),
        _log_odds(_votes(scores, WIDE_TEMPERATURE * spread), inside),
        (scores[inside].max(initial=last) - best_outside) / spread,
        inside[:3].mean(),
        inside[:VOTING_PHOTOS].mean(),
        inside.mean(),
        np.log1p(support / spread),
        np.log1p(run),
        (scores[0] - last) / spread,
    ]
    if len(neighbour_scores):
        first, last = scores[0], neighbour_scores[-1]
        features += [
            (first - neighbour_scores[~neighbours_inside].max(initial=last)) / spread,
            (first - neighbour_scores[neighbours_inside].max(initial=last)) / spread,
            np.log1p((neighbour_scores > first).sum()),
            (first - neighbour_scores[:VOTING_PHOTOS].mean()) / spread,
        ]
    else:
        features += [0.0] * 4
    return np.array(features, dtype=np.float64)


def ranking_spread(ranking: Sequence[RankedPhoto]) -> float:
    """Return the difference between the first and the last score, at least MIN_SPREAD."""
    return max(MIN_SPREAD, ranking[0].score - ranking[-1].score) if ranking else MIN_SPREAD


def vote_weights(ranking: Sequence[RankedPhoto], spread: float) -> FloatArray:
    """Return the weight of each photo's vote, 1 for the best."""
    return _votes(_scores(ranking), VOTE_TEMPERATURE * spread)


def _scores(ranking: Sequence[RankedPhoto]) -> FloatArray:
    return np.array([r.score for r in ranking], dtype=np.float64)


def _votes(scores: FloatArray, temperature: float) -> FloatArray:
    votes: FloatArray = np.exp((scores - scores.max(initial=-np.inf)) / temperature)
    return votes


def _log_odds(votes: FloatArray, inside: Mask) -> float:
    share = votes[inside].sum() / votes.sum()
    return float(np.log((share + MIN_SHARE) / (1 - share + MIN_SHARE)))


def _at_depth(paths: Sequence[tuple[str, ...]], depth: int, place: str) -> Mask:
    return np.array([depth < len(path) and path[depth] == place for path in paths], dtype=bool)


def _distances_m(center: PhotoLocation, ranking: Sequence[RankedPhoto]) -> FloatArray:
    """Return (k,) distances in metres; infinite for photos without coordinates."""
    if center.latitude is None or center.longitude is None:
        return np.full(len(ranking), np.inf)
    spots = np.array(
        [
            (np.nan, np.nan)
            if r.location.latitude is None
            else (r.location.latitude, r.location.longitude)
            for r in ranking
        ],
        dtype=np.float64,
    ).reshape(-1, 2)
    away = distances_m(center.latitude, center.longitude, spots[:, 0], spots[:, 1])
    return np.where(np.isnan(away), np.inf, away)
