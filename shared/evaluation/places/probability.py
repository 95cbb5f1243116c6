"""Probabilities of a place estimate: of each level, and that the place is not in the map.

Each is a logistic regression on the features of the ranking (`level_features`). `fit` fits
them to a map; without a fit, the coefficients are those of generated maps
(`lab/benchmarks/place_prior.py`), which order the levels of any map, but are far too certain
in a map of few photos. `thresholds` decides which level is the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from shared.evaluation.places.evidence import (
    EVIDENCE_DEPTH,
    PhotoLocation,
    RankedPhoto,
    are_matched,
    estimate_location,
    without_matches,
)
from shared.evaluation.places.levels import (
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
from shared.evaluation.places.thresholds import CERTAINTIES, Thresholds

CalibrationSource = Literal["prior", "own_photos", "labelled_queries"]

OUT_OF_MAP_SHARE = 0.02
SMALL_MAP_PHOTOS = 200  # with fewer, the coefficients stay near the prior's
PRIOR_FILE = Path(__file__).with_name("prior.json")

Coefficients = tuple[float, ...]
"""Intercept, then one coefficient per standardised feature."""


class PlacePrior(BaseModel):
    """Coefficients that were fitted on generated maps, and the standardisation of the features."""

    model_config = ConfigDict(frozen=True)

    means: tuple[float, ...]
    scales: tuple[float, ...]
    level: Coefficients
    not_in_map: Coefficients
    """log-odds if half of the queries are from outside the map"""

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
    """probability that the map has no photo of the place"""
    in_map: bool | None
    """whether the map has a photo of the place; None if the model has no limit"""
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
    not_in_map: Coefficients | None = None
    thresholds: tuple[Thresholds, ...] = ()
    """for each of CERTAINTIES"""
    in_map_limit: float | None = None
    """queries with a lower probability of "not in the map" show a place of the map"""
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

    def probabilities(self, levels: Sequence[CandidateLevel]) -> tuple[list[float], float]:
        """Return the probability of each level, finest first, and that of "not in the map".

        A level contains the finer ones, so the probabilities are made not to decrease. The place
        of the finest level cannot be right and missing: the two add up to 1 at most.
        """
        prior = shipped_prior()
        single = [
            _probability(self.levels[i] if i < len(self.levels) else prior.level, level)
            for i, level in enumerate(levels)
        ]
        increasing = np.maximum.accumulate(np.array(single)).tolist()
        shift = np.log(OUT_OF_MAP_SHARE / (1 - OUT_OF_MAP_SHARE))
        missing = _probability(self.not_in_map or prior.not_in_map, levels[0], float(shift))
        return increasing, min(missing, 1 - increasing[0])

    def missing_log_odds(
        self,
        ranking: Sequence[RankedPhoto],
        neighbours: Sequence[RankedPhoto],
        scheme: LevelScheme,
        position_radius_m: float,
    ) -> float | None:
        """Return the log-odds of "not in the map" if half of the queries are from outside it.

        Arguments are those of `estimate`. None without a fit, and for coordinates: in another
        season, all queries look as if they were not in the map.
        """
        ranking, unit = ranking[:EVIDENCE_DEPTH], self.unit(ranking[:EVIDENCE_DEPTH])
        near = neighbours[:EVIDENCE_DEPTH]
        levels = candidate_levels(ranking, near, scheme, unit, position_radius_m)
        if not self.is_fitted or not levels or levels[0].radius_m is not None:
            return None
        return _log_odds(self.not_in_map or shipped_prior().not_in_map, levels[0])

    def answer(
        self, probabilities: Sequence[float], not_in_map: float, certainty: float
    ) -> int | None:
        """Return the index of the finest level that is certain enough; None if none is."""
        if not self.is_fitted:
            return None
        stored = zip(CERTAINTIES, self.thresholds, strict=False)
        thresholds = next((t for known, t in stored if known >= certainty - 1e-9), Thresholds())
        return thresholds.answer(probabilities, not_in_map, certainty)

    def accepts(self, levels: Sequence[CandidateLevel]) -> bool | None:
        """Return whether a query with these levels shows a place of the map."""
        return self._is_in_map(self.probabilities(levels)[1])

    def _is_in_map(self, not_in_map: float) -> bool | None:
        return None if self.in_map_limit is None else not_in_map < self.in_map_limit

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
    ) -> PlaceEstimate | None:
        """Estimate the place of a query.

        Args:
            ranking: The first photos of the map, best first; `EVIDENCE_DEPTH` of them count.
            neighbours: The ranking of the best photo itself, without it.
            certainty: Share of the answers that must be right, above 0 and at most 1.
            position_radius_m: Photos within this distance of the best one determine the position.
            found: The ranking of a search with a filter; its photos determine the levels.

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
        probabilities, not_in_map = model.probabilities(levels)
        ordered = order_by_matches(shown[:EVIDENCE_DEPTH], unit)
        return PlaceEstimate(
            model=model,
            location=estimate_location(ordered, position_radius_m),
            levels=levels,
            probabilities=probabilities,
            answer=model.answer(probabilities, not_in_map, certainty),
            not_in_map=not_in_map,
            in_map=model._is_in_map(not_in_map),
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


def _probability(coefficients: Coefficients, level: CandidateLevel, shift: float = 0.0) -> float:
    return float(sigmoid(np.array(_log_odds(coefficients, level) + shift)))


def _log_odds(coefficients: Coefficients, level: CandidateLevel) -> float:
    design = shipped_prior().design(level.features[None])
    return float((design @ extended(coefficients, design.shape[1]))[0])


def extended(coefficients: Coefficients, count: int) -> FloatArray:
    """Return (count,) coefficients: those that the shipped prior lacks are 0."""
    return np.pad(np.array(coefficients), (0, count - len(coefficients)))


def sigmoid(x: NDArray[np.float64]) -> NDArray[np.float64]:
    probabilities: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-np.clip(x, -30, 30)))
    return probabilities
