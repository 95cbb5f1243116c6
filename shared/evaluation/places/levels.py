"""Levels of a place estimate: the places that a ranking points to, from the finest to the coarsest.

The levels of a *label path* such as `tower/floor 7/elevator` are its prefixes. The levels of
coordinates are circles of increasing radius around the estimated position. Each level has features
that say how clearly the ranking points to it; a model (`probability`) turns them into a
probability.

The features compare scores in units of the `spread` of a map's rankings, the median difference
between the first score and the last of `EVIDENCE_DEPTH`, so that extractors are comparable. Some of
them compare the query with the *neighbours* of the best photo, the photos of the map that are most
similar to it: a query that is less similar to it than many of its neighbours are was probably taken
elsewhere (local density, as in the local outlier factor of Breunig et al. 2000), and so was one
that finds other photos than it does (shared neighbours, Jarvis and Patrick 1973).

Where the local features of the first photos were matched with the query's, their matches vote for
the place, too, and each level has MATCH_FEATURES in addition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from shared.evaluation.places.evidence import (
    MATCHED_PHOTOS,
    VOTING_PHOTOS,
    PhotoLocation,
    RankedPhoto,
    are_matched,
    distance_between_m,
    estimate_location,
    is_same_place,
)
from shared.geodesy import distances_m
from shared.place_paths import is_within_level, label_levels

VOTE_TEMPERATURE = 0.1  # of the softmax over scores, in units of the spread
SHARED_DEPTHS = (5, 10, 20)  # first ranks whose photos are compared with the best photo's
WIDE_TEMPERATURE = 0.3
SUPPORT_PER_VOTE = 10.0  # match support that weighs as much as the vote of the best photo
MIN_SHARE = 1e-3  # of the votes; bounds the log-odds of a level that has all votes or none
MIN_SPREAD = 1e-6

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]


class LevelScheme(BaseModel):
    """What the levels of a map are."""

    model_config = ConfigDict(frozen=True)

    labels_are_paths: bool
    radii_m: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class CandidateLevel:
    """A level of an estimate: a place, or a circle around the estimated position."""

    place: str | None = None
    is_path: bool = False
    """whether `place` is a level of label paths, which contains the finer ones"""
    latitude: float | None = None
    longitude: float | None = None
    radius_m: float | None = None
    features: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(F,) FEATURES, followed by MATCH_FEATURES if the ranking was matched"""
    best_score: float = 0.0
    """of the photo of the map that is most similar to the query"""
    rival_score: float = 0.0
    """mean score of that photo with those of other places that are most similar to it"""
    is_whole_map: bool = False

    def contains(self, location: PhotoLocation) -> bool:
        """Return whether a location lies in the level."""
        if self.radius_m is not None:
            center = PhotoLocation(self.latitude, self.longitude, None)
            distance = distance_between_m(center, location)
            return distance is not None and distance <= self.radius_m
        if self.place is None or not self.is_path:
            return self.place is not None and location.place == self.place
        return is_within_level(location.place, self.place)

    def is_right(self, truth: PhotoLocation) -> bool | None:
        """Return whether the level contains the true location; None if the truth does not say.

        A label that ends above the level (`tower/floor 7` for `tower/floor 7/elevator`) does not
        say, and neither does a location without a label or without coordinates.
        """
        if self.contains(truth):
            return True
        if self.radius_m is not None:
            return None if truth.latitude is None else False
        levels = label_levels(truth.place, self.is_path)
        ends_above = self.is_path and bool(levels) and is_within_level(self.place, levels[0])
        return None if ends_above or not levels else False

    def is_within(self, other: CandidateLevel) -> bool:
        """Return whether the level is another one, or a finer one of its path.

        Circles are compared by the position of the other one, and by their sizes.
        """
        if self.radius_m is None:
            place = PhotoLocation(None, None, self.place)
            return replace(other, is_path=self.is_path).contains(place)
        center = PhotoLocation(other.latitude, other.longitude, None)
        return self.radius_m <= (other.radius_m or 0.0) and self.contains(center)


def candidate_levels(
    ranking: Sequence[RankedPhoto],
    neighbours: Sequence[RankedPhoto],
    scheme: LevelScheme,
    spread: float,
    position_radius_m: float,
    found: Sequence[RankedPhoto] | None = None,
) -> list[CandidateLevel]:
    """Find the levels that a ranking points to, with their features.

    The levels are circles if the best photo has coordinates and labels are no paths, and otherwise
    those of labels.

    Args:
        ranking: The first photos of the map, best first, for the features.
        neighbours: The ranking of the best photo itself, without it; empty if it is not known.
        spread: Unit of score differences.
        position_radius_m: Photos within this distance of the best one determine the position.
        found: The ranking that determines the levels, if a filter restricts it.

    Returns:
        The levels, finest first; empty if the best photos have no location.
    """
    found = ranking if found is None else found
    if not ranking or not found:
        return []
    found = order_by_matches(found, spread)
    if scheme.labels_are_paths or found[0].location.latitude is None:
        levels = _vote_for_places(found, scheme.labels_are_paths, spread)
    else:
        center = estimate_location(found, position_radius_m)
        levels = [
            CandidateLevel(latitude=center.latitude, longitude=center.longitude, radius_m=radius)
            for radius in sorted(scheme.radii_m)
        ]
    scores, neighbour_scores = _scores(ranking), _scores(neighbours)
    shared = shared_neighbours(ranking, neighbours)
    best, rival = ranking[0].score, _rival_score(ranking[0], neighbours, position_radius_m)
    matched, described = are_matched(ranking), []
    for level in levels:
        features = level_features(
            scores,
            photos_inside(level, ranking),
            neighbour_scores,
            photos_inside(level, neighbours),
            shared,
            spread,
        )
        if matched:
            of_matches = match_features(level, ranking[:MATCHED_PHOTOS])
            features = np.concatenate([features, of_matches])
        described.append(replace(level, features=features, best_score=best, rival_score=rival))
    return described


def _rival_score(
    best: RankedPhoto, neighbours: Sequence[RankedPhoto], position_radius_m: float
) -> float:
    """Return the mean score of the first neighbours that show another place than the best photo.

    Without any, it is that of the last neighbour, and without neighbours the best photo's own.
    """
    spot = best.location
    rivals = [n for n in neighbours if not is_same_place(spot, n.location, position_radius_m)]
    return float(np.mean([r.score for r in rivals[:VOTING_PHOTOS] or neighbours[-1:] or [best]]))


def shared_neighbours(
    ranking: Sequence[RankedPhoto], neighbours: Sequence[RankedPhoto]
) -> list[float]:
    """Return the share of the first photos that the best photo finds first, too.

    For each of SHARED_DEPTHS k, that is the number of photos that are among the first k of
    `ranking` and among the best photo and its first k - 1 neighbours, divided by k.
    """
    first = [r.photo for r in ranking]
    best = [*first[:1], *(n.photo for n in neighbours)]
    return [len({*first[:k]} & {*best[:k]} - {None}) / k for k in SHARED_DEPTHS]


def _vote_for_places(
    ranking: Sequence[RankedPhoto], is_path: bool, spread: float
) -> list[CandidateLevel]:
    """Choose a place at each level, from the coarsest, by the votes inside the one chosen before.

    The votes are weighted (`vote_weights`); a photo without a label has none. Where most votes are
    those of photos whose labels end at a level, the estimate ends there, too.
    """
    paths = [label_levels(r.location.place, is_path)[::-1] for r in ranking]
    votes = place_vote_weights(ranking, spread).tolist()
    chosen: list[CandidateLevel] = []
    voters = [index for index, path in enumerate(paths) if path]
    while True:
        depth = len(chosen)
        counts: dict[str, float] = {}
        ended = 0.0
        for index in voters:
            if depth < len(paths[index]):
                place = paths[index][depth]
                counts[place] = counts.get(place, 0.0) + votes[index]
            else:
                ended += votes[index]
        if not counts or max(counts.values()) < ended:
            return chosen[::-1]
        best = max(counts, key=lambda place: counts[place])
        chosen.append(CandidateLevel(place=best, is_path=is_path))
        voters = [i for i in voters if depth < len(paths[i]) and paths[i][depth] == best]


def photos_inside(level: CandidateLevel, ranking: Sequence[RankedPhoto]) -> Mask:
    """Return (k,) bool: which photos of a ranking lie in a level."""
    return np.array([level.contains(r.location) for r in ranking], dtype=bool)


def place_votes(
    level: CandidateLevel, ranking: Sequence[RankedPhoto], votes: FloatArray
) -> FloatArray:
    """Return (k,) for each photo of a ranking the votes of all photos of its place.

    They are those with its label or, if the level is a circle, within the radius around the photo;
    only the photo itself if it has no label or coordinates.
    """
    locations = [r.location for r in ranking]
    if level.radius_m is None:
        labels = [location.place for location in locations]
        together = np.array([[a is not None and a == b for b in labels] for a in labels])
    else:
        points = [(location.latitude, location.longitude) for location in locations]
        degrees = np.array(points, np.float64).reshape(-1, 2)
        latitudes, longitudes = degrees.T
        metres = [distances_m(lat, lon, latitudes, longitudes) for lat, lon in degrees]
        together = np.array(metres) <= level.radius_m
    return np.maximum(votes, together @ votes)


FEATURES = (
    "votes",
    "wide_votes",
    "margin",
    "second_margin",
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
    "neighbours_agreement_3",
    "neighbours_agreement_10",
    "neighbours_agreement",
    *(f"shared_neighbours_{depth}" for depth in SHARED_DEPTHS),
)
"""Names of a level's features, in the order of `level_features`."""


def level_features(
    scores: FloatArray,
    inside: Mask,
    neighbour_scores: FloatArray,
    neighbours_inside: Mask,
    shared: Sequence[float],
    spread: float,
) -> FloatArray:
    """Compute the features of a level.

    Args:
        scores: (k,) scores of the ranking, highest first.
        inside: (k,) which of its photos lie in the level.
        neighbour_scores: (n,) scores of the best photo's own ranking.
        neighbours_inside: (n,) which of these photos lie in the level.
        shared: `shared_neighbours` of both rankings.
        spread: Unit of score differences.

    Returns:
        (len(FEATURES),) float64: log-odds of the votes inside, at two temperatures; margins of the
        best and the second score inside over the best outside; share of the first 3, the first 10
        and all photos that lie inside; log of the summed margins of the first ten inside; log of
        the number of leading photos inside; first score minus last. Then the first score minus the
        best of a neighbour outside, and inside; log of the number of neighbours that are more
        similar to the best photo than the query is; the first score minus the mean of the first
        ten neighbours; share of the first 3, the first 10 and all neighbours that lie inside; and
        the shared neighbours. The features of neighbours are 0 without them.
    """
    last = scores[-1]
    best_outside = scores[~inside].max(initial=last)
    support = np.maximum(0.0, scores[:VOTING_PHOTOS][inside[:VOTING_PHOTOS]] - best_outside).sum()
    run = len(inside) if inside.all() else int(inside.argmin())
    features = [
        _log_odds(_votes(scores, VOTE_TEMPERATURE * spread), inside),
        _log_odds(_votes(scores, WIDE_TEMPERATURE * spread), inside),
        (scores[inside].max(initial=last) - best_outside) / spread,
        (scores[inside][1:].max(initial=last) - best_outside) / spread,
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
            neighbours_inside[:3].mean(),
            neighbours_inside[:VOTING_PHOTOS].mean(),
            neighbours_inside.mean(),
            *shared,
        ]
    else:
        features += [0.0] * (len(FEATURES) - len(features))
    return np.array(features, dtype=np.float64)


MATCH_FEATURES = (
    "best_support_inside",
    "best_support_outside",
    "best_support_ratio",
    "support_share",
    "support_inside",
)
"""Names of the features of matches, in the order of `match_features`."""
SUPPORT_UNIT = 100.0  # of the features; they are not standardised by the prior
SUPPORT_OFFSET = 8.0  # matches that two photos of different places have by chance


def match_features(level: CandidateLevel, ranking: Sequence[RankedPhoto]) -> FloatArray:
    """Compute the features of a level by the matches of the first photos.

    Returns:
        (len(MATCH_FEATURES),) float64: the largest match support of a photo inside, and outside;
        half the logarithm of their ratio, and of that of all support inside and outside; all
        support inside.
    """
    support = np.array([r.support or 0.0 for r in ranking])
    inside = photos_inside(level, ranking)
    best, rival = support[inside].max(initial=0), support[~inside].max(initial=0)
    total, rest = support[inside].sum(), support[~inside].sum()
    return np.array(
        [
            best / SUPPORT_UNIT,
            rival / SUPPORT_UNIT,
            np.log((best + SUPPORT_OFFSET) / (rival + SUPPORT_OFFSET)) / 2,
            np.log((total + SUPPORT_OFFSET) / (rest + SUPPORT_OFFSET)) / 2,
            total / (4 * SUPPORT_UNIT),
        ]
    )


def ranking_spread(ranking: Sequence[RankedPhoto]) -> float:
    """Return the difference between the first and the last score, at least MIN_SPREAD."""
    return max(MIN_SPREAD, ranking[0].score - ranking[-1].score) if ranking else MIN_SPREAD


def vote_weights(ranking: Sequence[RankedPhoto], spread: float) -> FloatArray:
    """Return the weight of each photo's vote, 1 for the best."""
    return _votes(_scores(ranking), VOTE_TEMPERATURE * spread)


def order_by_matches(ranking: Sequence[RankedPhoto], spread: float) -> list[RankedPhoto]:
    """Return a ranking by score and matches; one without matches stays as it is."""
    order = np.argsort(-place_vote_weights(ranking, spread), kind="stable")
    return [ranking[index] for index in order.tolist()]


def place_vote_weights(ranking: Sequence[RankedPhoto], spread: float) -> FloatArray:
    """Return the weight of each photo's vote for a place: by its score, and by its matches."""
    support = np.array([r.support or 0.0 for r in ranking])
    return vote_weights(ranking, spread) + support / SUPPORT_PER_VOTE


def _scores(ranking: Sequence[RankedPhoto]) -> FloatArray:
    return np.array([r.score for r in ranking], dtype=np.float64)


def _votes(scores: FloatArray, temperature: float) -> FloatArray:
    votes: FloatArray = np.exp((scores - scores.max(initial=-np.inf)) / temperature)
    return votes


def _log_odds(votes: FloatArray, inside: Mask) -> float:
    share = votes[inside].sum() / votes.sum()
    return float(np.log((share + MIN_SHARE) / (1 - share + MIN_SHARE)))
