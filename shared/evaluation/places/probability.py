"""Probabilities of a place estimate: of each level, and that the place is not in the map.

A query is from elsewhere, or the map has its place. The log-odds of "elsewhere" are the prior's,
plus a term for how similar the best photo is, in units of the scores of photos of different places
(`Background`), and one for how much more similar it is to the query than to photos of other places.
What photos of elsewhere score was measured on foreign photos
(`lab/benchmarks/place_prior.py`). Given that the map has the place, each level has a logistic
regression on the features of the ranking (`level_features`). All probabilities come from these two
and add up to one: a level's is that of "in this map" times its own, and a level that contains the
whole map says that the query is in it.

`fit` fits the levels to a map; without a fit, the coefficients are those of other maps.
`thresholds` decides which level is the answer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from shared.errors import Unprocessable
from shared.evaluation.places.evidence import (
    EVIDENCE_DEPTH,
    PhotoLocation,
    RankedPhoto,
    are_matched,
    estimate_location,
    without_matches,
)
from shared.evaluation.places.levels import (
    FEATURES,
    MIN_SPREAD,
    SUPPORT_UNIT,
    CandidateLevel,
    FloatArray,
    LevelScheme,
    candidate_levels,
    order_by_matches,
    photos_inside,
    place_votes,
    ranking_spread,
    vote_weights,
)
from shared.evaluation.places.thresholds import CERTAINTIES, guaranteed_threshold, have_dropped
from shared.geodesy import EARTH_RADIUS_M, distances_m
from shared.place_paths import label_levels

CalibrationSource = Literal["prior", "own_photos", "labelled_queries"]

OUT_OF_MAP_SHARE = 0.02  # of the frames of tracks, and of queries before a map is evaluated
UNMAPPED_SHARE = 0.05  # of queries within the map's extent whose place has no photo
ELSEWHERE_SHARE = 0.33  # of queries that are from elsewhere, unless the caller says otherwise
DEFAULT_CERTAINTY = 0.95
COPY_SCORE = 1 - 2**-11  # of the query's own picture; stored rows may be float16
MIN_LABELLED_QUERIES = 40
SMALL_MAP_PHOTOS = 2000  # with fewer, the coefficients stay near the prior's
PRIOR_FILE = Path(__file__).with_name("prior.json")

Coefficients = tuple[float, ...]
"""Intercept, then one coefficient per standardised feature."""


class Background(BaseModel):
    """Scores of random pairs of photos of a map, and matches of those of different places."""

    model_config = ConfigDict(frozen=True)

    mean: float
    deviation: float
    usual_deviation: float = 0.0
    """half the distance of the quantiles 0.16 and 0.84: few pairs show one place"""
    support: float = 0.0
    """`match_support` that one in ten pairs exceeds"""

    @classmethod
    def of(cls, scores: Sequence[float], supports: Sequence[float] = ()) -> Background:
        """Return those of the scores and the match supports of random pairs of photos."""
        if not scores:
            return cls(mean=0.0, deviation=1.0)
        low, high = np.quantile(scores, [0.16, 0.84])
        return cls(
            mean=float(np.mean(scores)),
            deviation=max(MIN_SPREAD, float(np.std(scores))),
            usual_deviation=float(high - low) / 2,
            support=float(np.quantile(supports, 0.9)) if len(supports) else 0.0,
        )


class Elsewhere(BaseModel):
    """What photos of elsewhere score, as the log-odds that a query is one of them."""

    model_config = ConfigDict(frozen=True)

    coefficients: Coefficients
    """intercept, with a prior of one half; of the similarity; of its excess over rivals"""
    matched: Coefficients
    """the same with matches, and of the logarithm of the largest match support"""
    background: Background | None = None
    """unit of the similarity; None: that of the map"""

    def features(self, levels: Sequence[CandidateLevel]) -> FloatArray:
        """Return the similarity of the best photo, how far it exceeds that of this photo with
        other places (adaptive score normalisation; Matejka et al. 2017), and, with matches, the
        logarithm of 1 + the largest match support.
        """
        assert self.background is not None
        finest, unit = levels[0], self.background.deviation
        similarity = (finest.best_score - self.background.mean) / unit
        excess = (finest.best_score - finest.rival_score) / unit
        of_matches = finest.features[len(FEATURES) :]
        largest = SUPPORT_UNIT * of_matches[:2].max(initial=0.0)
        described = np.array([similarity, excess, np.log1p(largest)])
        return described if len(of_matches) else described[:2]

    def of_map(self, pairs: Background) -> Elsewhere:
        """Return those of a map, all of whose photos may show the same thing, such as a vehicle.

        Without matches, the unit is that of the map's random pairs if it is larger. If their
        matches alone would say that they show one place, matches do not count.
        """
        unit, (intercept, *slopes) = self.background or pairs, self.coefficients
        ratio = unit.deviation / max(unit.deviation, pairs.usual_deviation)
        plain = (intercept, *(ratio * slope for slope in slopes))
        alike = self.matched[0] + self.matched[-1] * np.log1p(pairs.support) < np.log(0.05 / 0.95)
        matched = (*plain, 0.0) if alike else self.matched
        return Elsewhere(coefficients=plain, matched=matched, background=unit)

    def probability(self, levels: Sequence[CandidateLevel], share: float) -> float:
        """Return the probability that a query is from elsewhere, with the prior `share`."""
        features = self.features(levels)
        intercept, *slopes = self.coefficients if len(features) == 2 else self.matched
        log_odds = intercept + float(features @ np.array(slopes))
        return float(sigmoid(np.array(log_odds + np.log(share / (1 - share)))))


class MapExtent(BaseModel):
    """The size of a map, or the label that all of its photos share."""

    model_config = ConfigDict(frozen=True)

    diameter_m: float | None = None
    """distance that no two photos exceed; None if a photo has no coordinates"""
    place: str | None = None
    """finest level of labels that all photos share"""

    @classmethod
    def of(cls, locations: Sequence[PhotoLocation], scheme: LevelScheme) -> MapExtent:
        """Return the extent of photos with these locations."""
        paths = [label_levels(spot.place, scheme.labels_are_paths) for spot in locations]
        first = paths[0] if paths else []
        shared = [place for place in first if all(place in path for path in paths)]
        points = [
            (spot.latitude, spot.longitude)
            for spot in locations
            if spot.latitude is not None and spot.longitude is not None
        ]
        diameter_m = None
        if points and len(points) == len(locations):
            latitudes, longitudes = np.array(points).T
            longitudes = (longitudes - longitudes[0] + 180) % 360  # both sides of the antimeridian
            north, east = ((each.min() + each.max()) / 2 for each in (latitudes, longitudes))
            away_m = distances_m(north, east, latitudes, longitudes).max()
            diameter_m = min(2 * float(away_m), math.pi * EARTH_RADIUS_M)
        return cls(diameter_m=diameter_m, place=shared[0] if shared else None)

    def end_levels(self, levels: Sequence[CandidateLevel]) -> list[CandidateLevel]:
        """Return the levels that are smaller than the map, and as the last one the whole map."""
        finest_m, labels = levels[0].radius_m, [level.place for level in levels]
        whole = replace(levels[-1], is_whole_map=True)
        if finest_m is not None and self.diameter_m is not None:
            radius_m = max(finest_m, self.diameter_m)
            whole = replace(whole, radius_m=radius_m)
            smaller = [level for level in levels if (level.radius_m or 0.0) < radius_m]
        else:  # a photo without coordinates may be anywhere
            whole = replace(whole, place=self.place, latitude=None, longitude=None, radius_m=None)
            end = labels.index(self.place) if self.place and self.place in labels else None
            smaller = list(levels[:end])
        return [*smaller, whole]


class PlacePrior(BaseModel):
    """Coefficients that were fitted on other maps, and the standardisation of the features."""

    model_config = ConfigDict(frozen=True)

    means: tuple[float, ...]
    scales: tuple[float, ...]
    level: Coefficients
    matched: Coefficients = ()
    """those of a level with matches"""
    missing_place: Coefficients
    """log-odds that the map has no photo of the place, if that holds for half of the queries"""
    elsewhere: dict[str, Elsewhere] = {}
    """by extractor, for maps with a vocabulary of their own; "" for all others"""

    def level_coefficients(self, features: int) -> Coefficients:
        """Return those of a level with so many features."""
        return self.matched if features > len(FEATURES) else self.level

    def design(self, features: FloatArray) -> FloatArray:
        """Return the (n, 1 + F) design matrix of (n, F) features; those of matches stay as they
        are."""
        known = len(self.means)
        standardised = (features[:, :known] - np.array(self.means)) / np.array(self.scales)
        return np.column_stack([np.ones(len(features)), standardised, features[:, known:]])


@cache
def shipped_prior() -> PlacePrior:
    """Return the prior of this release."""
    return PlacePrior.model_validate_json(PRIOR_FILE.read_text(encoding="utf-8"))


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """Probabilities of an estimate."""

    model: PlaceModel
    """that was used: with or without matches"""
    location: PhotoLocation
    """of the best photos: their position, and the label of the first"""
    levels: Sequence[CandidateLevel]
    """finest first"""
    probabilities: Sequence[float]
    """of the levels; a level is never less probable than a finer one"""
    answer: int | None
    """index of the finest level that is certain enough"""
    not_in_map: float
    """probability that the query is from elsewhere"""
    in_map: bool | None
    """True if "in this map" is certain enough, False if "not in this map" is more probable, None
    in between, and without a fit"""
    radius_68_m: float | None
    radius_95_m: float | None
    match_probabilities: Sequence[float]
    """for each photo of the ranking: that it shows the query's place, at the finest level"""


class PlaceModel(BaseModel):
    """Probability model of the estimates of one map and generation. It is stored with it."""

    model_config = ConfigDict(frozen=True)

    source: CalibrationSource = "prior"
    """what the coefficients and thresholds were fitted on"""
    scheme: LevelScheme | None = None
    """levels that the model was fitted for; None for those of any map"""
    spread: float | None = None
    """unit of score differences; None: that of each ranking"""
    levels: tuple[Coefficients, ...] = ()
    """by position, finest first; further levels have the prior's"""
    missing_place: Coefficients | None = None
    elsewhere: Elsewhere | None = None
    extent: MapExtent = MapExtent()
    thresholds: tuple[float, ...] = ()
    """least probability of an answer, for each of CERTAINTIES"""
    mistaken: tuple[float, ...] = ()
    """share of own photos that get a wrong answer where the map lacks their place, for each of
    CERTAINTIES"""
    best_scores: tuple[float, ...] = ()
    """quantiles of the score of the best photo, of the queries that the model was fitted on"""
    wrong_until: tuple[float, ...] = ()
    """`HeldOutEstimate.wrong_until` of the labelled queries"""
    own_photos: int = 0
    labelled_queries: int = 0
    with_matches: PlaceModel | None = None
    """the model of queries whose first photos were matched; None if matches do not help the map"""

    @property
    def is_fitted(self) -> bool:
        """Whether the probabilities were fitted to the map; those of the prior answer nothing."""
        return self.source != "prior"

    @property
    def calibration_source(self) -> CalibrationSource:
        """What determines the probabilities most: in a small map without labelled queries, the
        prior that they are shrunk towards."""
        is_small = self.source == "own_photos" and self.own_photos < SMALL_MAP_PHOTOS
        return "prior" if is_small else self.source

    def for_scheme(self, scheme: LevelScheme) -> PlaceModel:
        """Return this model, or the prior if the map's levels changed since it was fitted."""
        return self if self.scheme in (None, scheme) else PlaceModel()

    def probabilities(
        self, levels: Sequence[CandidateLevel], elsewhere: float = ELSEWHERE_SHARE
    ) -> tuple[list[float], float]:
        """Return the probability of each level, finest first, and that of "not in this map".

        A level contains the finer ones, so the probabilities are made not to decrease. With n own
        photos and labelled queries, none exceeds (n + 1) / (n + 2).

        Args:
            levels: Those of `MapExtent.end_levels`.
            elsewhere: Prior probability that a query is from elsewhere.
        """
        prior, fitted = shipped_prior(), dict(enumerate(self.levels))
        missing = self.elsewhere.probability(levels, elsewhere) if self.elsewhere else elsewhere
        if self.is_fitted:  # Laplace's rule of succession
            missing = max(missing, 1 / (self.own_photos + self.labelled_queries + 2))
        single = [
            1.0
            if level.is_whole_map
            else sigmoid(
                _log_odds(fitted.get(i, prior.level_coefficients(len(level.features))), level)
            )
            for i, level in enumerate(levels)
        ]
        increasing = (1 - missing) * np.maximum.accumulate(np.array(single))
        return increasing.tolist(), missing

    def missing_log_odds(
        self,
        ranking: Sequence[RankedPhoto],
        neighbours: Sequence[RankedPhoto],
        scheme: LevelScheme,
        position_radius_m: float,
    ) -> float | None:
        """Return the log-odds that the map lacks the place, if it does for half of the queries.

        Arguments are those of `estimate`. None without a fit, and for coordinates: in another
        season, all queries look as if they were not in the map.
        """
        ranking, unit = ranking[:EVIDENCE_DEPTH], self.unit(ranking[:EVIDENCE_DEPTH])
        near = neighbours[:EVIDENCE_DEPTH]
        levels = candidate_levels(ranking, near, scheme, unit, position_radius_m)
        if not self.is_fitted or not levels or levels[0].radius_m is not None:
            return None
        return _log_odds(self.missing_place or shipped_prior().missing_place, levels[0])

    def is_in_map(self, not_in_map: float, certainty: float = DEFAULT_CERTAINTY) -> bool | None:
        """Return `PlaceEstimate.in_map`."""
        if not self.is_fitted:
            return None
        if not_in_map <= 1 - certainty + 1e-9:
            return True
        return False if not_in_map > 0.5 else None

    def accepts(self, levels: Sequence[CandidateLevel]) -> bool | None:
        """Return `PlaceEstimate.in_map` of a query with these levels."""
        return self.is_in_map(self.probabilities(self.extent.end_levels(levels))[1])

    def may_lack_place(self, estimate: PlaceEstimate, score: float, elsewhere: float) -> bool:
        """Return whether a photo of unknown place shows the query's place more probably than those
        of an estimate do.

        It leads the best of them by more than the first photo of a ranking does the last, and is no
        copy of the query; or no level is probable, and it is too similar for a photo of elsewhere.

        Args:
            score: Of the photo.
            elsewhere: As in `probabilities`.
        """
        finest = estimate.levels[0]
        if score < COPY_SCORE and score - finest.best_score > (self.spread or math.inf):
            return True
        if estimate.answer is not None or max(estimate.probabilities[:-1], default=0.0) >= 0.5:
            return False
        unmatched = finest.features[: len(FEATURES)]
        as_best = replace(finest, best_score=score, features=unmatched)
        return self.is_in_map(self.probabilities([as_best], elsewhere)[1]) is not False

    def threshold(self, certainty: float, guarantee: float | None = None) -> float:
        """Return how probable a level must be to be the answer.

        Args:
            guarantee: Share of all queries that may get a wrong answer, instead of the certainty.

        Raises:
            Unprocessable: `too_few_labelled_queries` for the guarantee.
        """
        if guarantee is None:
            return _at_certainty(self.thresholds, certainty, certainty)
        least = guaranteed_threshold(self.wrong_until, guarantee)
        if least is None:
            needed = max(MIN_LABELLED_QUERIES, math.ceil(1 / guarantee - 1 - 1e-9))
            raise Unprocessable(
                "too_few_labelled_queries",
                f"A guarantee of {guarantee:g} takes {needed} labelled queries of another session "
                f"than the photos that they match, and the last evaluation of the map had "
                f"{len(self.wrong_until)}. Add photos with role=query, and evaluate the map.",
                needed=needed,
            )
        return least

    def mistaken_share(self, certainty: float) -> float:
        """Return the share of own photos that get a wrong answer where the map lacks their place.

        It is what look-alikes can do that the map itself shows, such as floors built alike.
        """
        return _at_certainty(self.mistaken, certainty, 0.0)

    def is_new(self, recent: Sequence[float]) -> bool:
        """Return whether queries are new to the map, by the scores of their best photos."""
        return have_dropped(
            recent, self.best_scores, self.labelled_queries or max(1, self.own_photos)
        )

    def answer(
        self,
        probabilities: Sequence[float],
        not_in_map: float,
        certainty: float,
        guarantee: float | None = None,
    ) -> int | None:
        """Return the index of the finest level that is certain enough; None if none is.

        Where "in this map" is, that is the whole map at least.
        """
        if not self.is_in_map(not_in_map, certainty):
            return None
        least = self.threshold(certainty, guarantee)
        enough = (index for index, each in enumerate(probabilities) if each >= least)
        return next(enough, len(probabilities) - 1)

    def unit(self, ranking: Sequence[RankedPhoto]) -> float:
        """Return the unit of score differences for a ranking."""
        return self.spread or ranking_spread(ranking)

    def estimate(
        self,
        ranking: Sequence[RankedPhoto],
        neighbours: Sequence[RankedPhoto],
        scheme: LevelScheme,
        certainty: float,
        position_radius_m: float,
        found: Sequence[RankedPhoto] | None = None,
        elsewhere: float = ELSEWHERE_SHARE,
        guarantee: float | None = None,
    ) -> PlaceEstimate | None:
        """Estimate the place of a query.

        Args:
            ranking: The first photos of the map, best first; `EVIDENCE_DEPTH` of them count.
            neighbours: The ranking of the best photo itself, without it.
            certainty: Share of the answers that must be right, above 0 and at most 1.
            position_radius_m: Photos within this distance of the best one determine the position.
            found: The ranking of a search with a filter; its photos determine the levels.
            elsewhere: Prior probability that the query is from elsewhere.
            guarantee: As in `threshold`.

        Returns:
            The estimate; None if the ranking has no location.
        """
        shown = ranking if found is None else found
        model = self.with_matches if are_matched(ranking) and self.with_matches else self
        if model is self:
            ranking, shown = without_matches(ranking), without_matches(shown)
        evidence, unit = ranking[:EVIDENCE_DEPTH], model.unit(ranking[:EVIDENCE_DEPTH])
        levels = candidate_levels(
            evidence,
            neighbours[:EVIDENCE_DEPTH],
            scheme,
            unit,
            position_radius_m,
            shown[:EVIDENCE_DEPTH],
        )
        if not levels:
            return None
        levels = model.extent.end_levels(levels)
        probabilities, not_in_map = model.probabilities(levels, elsewhere)
        ordered = order_by_matches(shown[:EVIDENCE_DEPTH], unit)
        return PlaceEstimate(
            model=model,
            location=estimate_location(ordered, position_radius_m),
            levels=levels,
            probabilities=probabilities,
            answer=model.answer(probabilities, not_in_map, certainty, guarantee),
            not_in_map=not_in_map,
            in_map=model.is_in_map(not_in_map, certainty),
            radius_68_m=error_radius_m(levels, probabilities, 0.68),
            radius_95_m=error_radius_m(levels, probabilities, 0.95),
            match_probabilities=_match_probabilities(
                shown, levels[0], probabilities[0], not_in_map, vote_weights(shown, unit)
            ),
        )


def error_radius_m(
    levels: Sequence[CandidateLevel], probabilities: Sequence[float], share: float
) -> float | None:
    """Return the radius that contains the true position with a probability, in metres.

    Between two radii the probability is interpolated linearly in the radius, from 0 at 0 m.

    Returns:
        None for levels without radii, or if the largest is less probable than `share`.
    """
    inner_m = inner = 0.0
    for level, probability in zip(levels, probabilities, strict=True):
        if level.radius_m is None:
            return None
        if probability >= share:
            return inner_m + (level.radius_m - inner_m) * (share - inner) / (probability - inner)
        inner_m, inner = level.radius_m, probability
    return None


def _match_probabilities(
    ranking: Sequence[RankedPhoto],
    finest: CandidateLevel,
    probability: float,
    not_in_map: float,
    votes: FloatArray,
) -> list[float]:
    """Return the probability of each photo of a ranking that it shows the query's place.

    The finest level's for the photos in it. The places of the others share by votes what it and
    `not_in_map` leave, but none of them is more probable than the finest level.
    """
    inside = photos_inside(finest, ranking)
    remaining = max(0.0, 1 - probability - not_in_map)
    other_votes = np.where(inside, 0.0, votes)
    shares = place_votes(finest, ranking, other_votes) / max(float(other_votes.sum()), 1e-12)
    others = np.minimum(remaining * shares, probability)
    matches: list[float] = np.where(inside, probability, others).tolist()
    return matches


def _at_certainty(values: Sequence[float], certainty: float, otherwise: float) -> float:
    """Return the value of the next higher of CERTAINTIES."""
    stored = zip(CERTAINTIES, values, strict=False)
    return next((value for known, value in stored if known >= certainty - 1e-9), otherwise)


def _log_odds(coefficients: Coefficients, level: CandidateLevel) -> float:
    design = shipped_prior().design(level.features[None])
    return float((design @ extended(coefficients, design.shape[1]))[0])


def extended(coefficients: Coefficients, count: int) -> FloatArray:
    """Return (count,) coefficients: those that the shipped prior lacks are 0."""
    return np.pad(np.array(coefficients), (0, count - len(coefficients)))


def sigmoid(x: NDArray[np.float64] | float) -> NDArray[np.float64]:
    probabilities: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-np.clip(x, -30, 30)))
    return probabilities
