"""Probabilities of a place estimate: of each level, and that the place is not in the map.

Each is a logistic regression on the features of the ranking (`level_features`), fitted by maximum a
posteriori. The Gaussian prior is centred on coefficients that were fitted on generated maps
(`tools/make_place_prior.py`): a small map stays near them, a large one follows its own photos.

The samples are the map's own photos, each searched without itself, and *impostors*: the same photos
searched as if the map had no photo of a place that shows them. Impostors have the total weight
`OUT_OF_MAP_SHARE`: that share of queries from outside the map is assumed. Labelled queries, if
there are enough, refine the coefficients, with those of the own photos as the prior.

The estimate *answers* at the finest level whose probability reaches the level's threshold for a
certainty c. The threshold is the lowest for which the share c of the cross-validated answers at
this level is right, with one more wrong answer counted, as in conformal selection
(Jin and Candes 2023). An answer at the finest level also needs a probability of "not in the map"
below a limit that at most the share 1 - c of the impostors passes (split conformal prediction, Vovk
et al. 2005). Where there are too few samples for a threshold, it is c itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from shared.evaluation.place_evidence import EVIDENCE_DEPTH, RankedPhoto
from shared.evaluation.place_levels import (
    FEATURES,
    CandidateLevel,
    FloatArray,
    LevelScheme,
    candidate_levels,
    photos_inside,
    ranking_spread,
    vote_weights,
)

CalibrationSource = Literal["prior", "own_photos", "labelled_queries"]

OUT_OF_MAP_SHARE = 0.05
MIN_OWN_PHOTOS = 20
MIN_LABELLED_QUERIES = 40
PRIOR_PRECISION = 2.0  # of each coefficient of a standardised feature
NEWTON_STEPS = 50
FOLDS = 5
MAX_ERROR_FACTOR = 5.0  # of an answer's error probability over 1 - certainty
CERTAINTIES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.97, 0.98, 0.99, 0.995)
"""Certainties with stored thresholds; a request uses those of the next higher one."""
PRIOR_FILE = Path(__file__).with_name("place_prior.json")

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
        """Return the (n, 1 + F) design matrix of (n, F) features."""
        standardised = (features - np.array(self.means)) / np.array(self.scales)
        return np.column_stack([np.ones(len(features)), standardised])


@cache
def shipped_prior() -> PlacePrior:
    """Return the prior of this release."""
    return PlacePrior.model_validate_json(PRIOR_FILE.read_text(encoding="utf-8"))


@dataclass(frozen=True, slots=True, eq=False)
class PlaceSample:
    """The levels of the estimate for a photo whose location is known."""

    photo: int
    """number of the photo; samples of one photo are held out together"""
    levels: Sequence[CandidateLevel]
    """finest first, not empty"""
    is_right: Sequence[bool | None]
    """for each level; None if the truth does not say"""
    left_out: str | None = None
    """what was left out of the map to make the photo an impostor; None if it is none"""


class Thresholds(BaseModel):
    """When an estimate answers at one certainty."""

    model_config = ConfigDict(frozen=True)

    not_in_map: float | None
    """maximum for an answer at the finest level; None: no limit is known"""
    levels: tuple[float | None, ...]
    """minimum probability by position, finest first; None: the certainty itself"""


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """Probabilities of an estimate."""

    levels: Sequence[CandidateLevel]
    """finest first"""
    probabilities: Sequence[float]
    """of the levels; a level is never less probable than a finer one"""
    answer: int | None
    """index of the finest level that is certain enough"""
    not_in_map: float
    """probability that the map has no photo of the place"""
    radius_68_m: float | None
    radius_95_m: float | None
    match_probabilities: Sequence[float]
    """for each photo of the ranking: that it shows the query's place, at the finest level"""


class PlaceModel(BaseModel):
    """Probability model of the estimates of one map and generation, stored with its calibration."""

    model_config = ConfigDict(frozen=True)

    version: int = 1
    source: CalibrationSource = "prior"
    scheme: LevelScheme | None = None
    """levels that the model was fitted for; None for those of any map"""
    spread: float | None = None
    """unit of score differences; None: that of each ranking"""
    levels: tuple[Coefficients, ...] = ()
    """by position, finest first; further levels have the prior's"""
    not_in_map: Coefficients | None = None
    thresholds: tuple[Thresholds, ...] = ()
    """for each of CERTAINTIES"""
    own_photos: int = 0
    labelled_queries: int = 0

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

    def answer(
        self, probabilities: Sequence[float], not_in_map: float, certainty: float
    ) -> int | None:
        """Return the index of the finest level that is certain enough; None if none is."""
        for known, thresholds in zip(CERTAINTIES, self.thresholds, strict=False):
            if known >= certainty - 1e-9:
                return _first_answer(probabilities, not_in_map, certainty, thresholds)
        return _first_answer(
            probabilities, not_in_map, certainty, Thresholds(not_in_map=None, levels=())
        )

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
            scheme: The levels of the map.
            certainty: Share of the answers that must be right, above 0 and at most 1.
            position_radius_m: Photos within this distance of the best one determine the position.
            found: The ranking of a search with a filter; its photos determine the levels.

        Returns:
            The estimate; None if the ranking has no location.
        """
        evidence, unit = ranking[:EVIDENCE_DEPTH], self.unit(ranking[:EVIDENCE_DEPTH])
        shown = ranking if found is None else found
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
        probabilities, not_in_map = self.probabilities(levels)
        return PlaceEstimate(
            levels=levels,
            probabilities=probabilities,
            answer=self.answer(probabilities, not_in_map, certainty),
            not_in_map=not_in_map,
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
    """Give the photos of the finest level its probability; the others share the rest by votes."""
    inside = photos_inside(finest, ranking)
    remaining = max(0.0, 1 - probability - not_in_map)
    shares = remaining * votes / max(float(votes[~inside].sum()), 1e-12)
    matches: list[float] = np.where(inside, probability, shares).tolist()
    return matches


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutEstimate:
    """Probabilities of a sample that the model was not fitted on."""

    probabilities: Sequence[float]
    not_in_map: float
    is_right: Sequence[bool | None]
    left_out: str | None
    weight: float


@dataclass(frozen=True, slots=True)
class FittedPlaceModel:
    """A model with the held-out estimates that its thresholds were chosen on."""

    model: PlaceModel
    held_out: Sequence[HeldOutEstimate]
    """labelled queries, or the map's own photos; empty for the prior"""
    impostors: Sequence[HeldOutEstimate]


def fit_place_model(
    samples: Sequence[PlaceSample],
    labelled: Sequence[PlaceSample],
    scheme: LevelScheme,
    spread: float,
) -> FittedPlaceModel:
    """Fit the model of a map.

    Args:
        samples: The map's own photos and their impostors.
        labelled: Labelled queries, taken in another session than the photos that they match.
        scheme: The levels of the map.
        spread: Unit of score differences of the samples' features.

    Returns:
        The model; the prior with fewer than MIN_OWN_PHOTOS own photos and fewer than
        MIN_LABELLED_QUERIES labelled queries.
    """
    own = sum(sample.left_out is None for sample in samples)
    if len(labelled) < MIN_LABELLED_QUERIES:
        labelled = ()
    if own < MIN_OWN_PHOTOS and not labelled:
        return FittedPlaceModel(PlaceModel(), [], [])
    own_held_out, labelled_held_out = _predict_held_out(samples, labelled, scheme, spread)
    thresholds = tuple(
        _choose_thresholds(own_held_out, labelled_held_out, certainty) for certainty in CERTAINTIES
    )
    model = _fit_coefficients(samples, labelled, scheme, spread).model_copy(
        update={"thresholds": thresholds, "own_photos": own}
    )
    in_map = labelled_held_out or [s for s in own_held_out if s.left_out is None]
    return FittedPlaceModel(model, in_map, [s for s in own_held_out if s.left_out is not None])


def _fit_coefficients(
    samples: Sequence[PlaceSample],
    labelled: Sequence[PlaceSample],
    scheme: LevelScheme,
    spread: float,
) -> PlaceModel:
    prior = shipped_prior()
    positions = max((len(sample.levels) for sample in [*samples, *labelled]), default=0)
    levels = []
    for position in range(positions):
        own = fit_map_estimate(_level_table(samples, position), prior.level)
        levels.append(fit_map_estimate(_level_table(labelled, position), own))
    return PlaceModel(
        source="labelled_queries" if labelled else "own_photos",
        scheme=scheme,
        spread=spread,
        levels=tuple(levels),
        not_in_map=fit_map_estimate(not_in_map_table(samples), prior.not_in_map),
        labelled_queries=len(labelled),
    )


@dataclass(frozen=True, slots=True, eq=False)
class RegressionTable:
    """Samples of a logistic regression."""

    features: FloatArray
    """(n, F)"""
    target: FloatArray
    """(n,) 0 or 1"""
    weights: FloatArray
    """(n,)"""

    @classmethod
    def of_rows(cls, rows: Iterable[tuple[FloatArray, bool, float]]) -> RegressionTable:
        """Make a table of (features, target, weight) rows."""
        columns = list(zip(*rows, strict=True)) or [(), (), ()]
        return cls(
            np.array(columns[0], dtype=np.float64).reshape(-1, len(FEATURES)),
            np.array(columns[1], dtype=np.float64),
            np.array(columns[2], dtype=np.float64),
        )


def _level_table(samples: Sequence[PlaceSample], position: int) -> RegressionTable:
    weights = sample_weights(samples, OUT_OF_MAP_SHARE)
    return RegressionTable.of_rows(
        (sample.levels[position].features, right, weight)
        for sample, weight in zip(samples, weights, strict=True)
        if position < len(sample.levels) and (right := sample.is_right[position]) is not None
    )


def not_in_map_table(samples: Sequence[PlaceSample]) -> RegressionTable:
    """Return the samples of "not in the map", half of them impostors by weight."""
    weights = sample_weights(samples, 0.5)
    return RegressionTable.of_rows(
        (sample.levels[0].features, sample.left_out is not None, weight)
        for sample, weight in zip(samples, weights, strict=True)
    )


def sample_weights(samples: Sequence[PlaceSample], share: float) -> list[float]:
    """Weigh own photos 1, and impostors so that each kind has the same part of `share`."""
    kinds = Counter(sample.left_out for sample in samples)
    own = kinds.pop(None, 0)
    total = own * share / (1 - share)
    return [
        1.0 if sample.left_out is None else total / len(kinds) / kinds[sample.left_out]
        for sample in samples
    ]


def fit_map_estimate(
    table: RegressionTable, center: Coefficients, prior: PlacePrior | None = None
) -> Coefficients:
    """Fit a logistic regression by maximum a posteriori, with Newton's method.

    Args:
        table: The samples; without any, the result is `center`.
        center: Mean of the Gaussian prior of the coefficients, with PRIOR_PRECISION.
        prior: Standardises the features; the shipped prior by default.
    """
    design = (prior or shipped_prior()).design(table.features)
    mean = np.array(center)
    beta = mean.copy()

    def loss(beta: FloatArray) -> float:
        margin = np.where(table.target > 0.5, 1, -1) * (design @ beta)
        fit = float(table.weights @ np.logaddexp(0.0, -margin))
        return fit + PRIOR_PRECISION / 2 * float(((beta - mean) ** 2).sum())

    for _ in range(NEWTON_STEPS if len(design) else 0):
        probability = _sigmoid(design @ beta)
        gradient = design.T @ (table.weights * (table.target - probability))
        gradient -= PRIOR_PRECISION * (beta - mean)
        variance = table.weights * probability * (1 - probability)
        hessian = (design.T * variance) @ design + PRIOR_PRECISION * np.eye(len(beta))
        step = np.linalg.solve(hessian, gradient)
        # A full step may overshoot where the prior's predictions are extreme.
        while loss(beta + step) > loss(beta) and float(np.abs(step).max()) > 1e-8:
            step /= 2
        beta += step
        if float(np.abs(step).max()) < 1e-8:
            break
    return tuple(beta.tolist())


def _predict_held_out(
    samples: Sequence[PlaceSample],
    labelled: Sequence[PlaceSample],
    scheme: LevelScheme,
    spread: float,
) -> tuple[list[HeldOutEstimate], list[HeldOutEstimate]]:
    """Predict the samples and the labelled queries by cross-validation."""
    predicted: tuple[list[HeldOutEstimate], list[HeldOutEstimate]] = ([], [])
    for fold in range(FOLDS):
        own, queries = (
            [s for s in each if s.photo % FOLDS != fold] for each in (samples, labelled)
        )
        model = _fit_coefficients(own, queries, scheme, spread)
        for each, into in zip((samples, labelled), predicted, strict=True):
            held_out = [s for s in each if s.photo % FOLDS == fold]
            weights = sample_weights(held_out, OUT_OF_MAP_SHARE)
            into += [
                HeldOutEstimate(*model.probabilities(s.levels), s.is_right, s.left_out, weight)
                for s, weight in zip(held_out, weights, strict=True)
            ]
    return predicted


def _choose_thresholds(
    samples: Sequence[HeldOutEstimate], labelled: Sequence[HeldOutEstimate], certainty: float
) -> Thresholds:
    """Choose the thresholds of a certainty, from the finest level to the coarsest.

    A level answers what the finer ones leave, so its threshold is chosen on the remaining ones.
    """
    judged = labelled or samples
    impostors = [s for s in samples if s.left_out is not None]
    # The limit that holds for all impostors is loosened to one for those that get an answer.
    limit = _upper_limit([s.not_in_map for s in impostors], certainty)
    within = [s for s in judged if limit is None or s.not_in_map <= limit]
    finest = _lowest_threshold(within, 0, certainty)
    cut = certainty if finest is None else finest
    limit = _upper_limit(
        [s.not_in_map if s.probabilities[0] >= cut else np.inf for s in impostors], certainty
    )
    remaining = list(judged)
    levels: list[float | None] = []
    for position in range(max((len(s.probabilities) for s in judged), default=0)):
        eligible = [
            s
            for s in remaining
            if position < len(s.probabilities)
            and (position > 0 or limit is None or s.not_in_map <= limit)
        ]
        threshold = _lowest_threshold(eligible, position, certainty)
        if position == 0 and threshold is not None:
            threshold = max(threshold, cut)  # the limit holds above it only
        levels.append(threshold)
        cut = certainty if threshold is None else threshold
        answered = {id(s) for s in eligible if s.probabilities[position] >= cut}
        remaining = [s for s in remaining if id(s) not in answered]
    return Thresholds(not_in_map=limit, levels=tuple(levels))


def _upper_limit(values: Sequence[float], certainty: float) -> float | None:
    """Return a limit that at most the share 1 - `certainty` of new values does not exceed.

    None with too few values for it.
    """
    rank = int((1 - certainty) * (len(values) + 1) + 1e-9)
    if rank == 0:
        return None
    return min(1.0, float(np.nextafter(sorted(values)[rank - 1], -np.inf)))


def _lowest_threshold(
    estimates: Sequence[HeldOutEstimate], position: int, certainty: float
) -> float | None:
    """Return the lowest probability above which the share `certainty` of the estimates is right.

    It is at least the probability with MAX_ERROR_FACTOR times the error that is allowed on
    average, and 0.5: queries may be harder than the samples.
    """
    known = [
        (s.probabilities[position], s.weight, s.weight * (not s.is_right[position]))
        for s in estimates
        if position < len(s.probabilities) and s.is_right[position] is not None
    ]
    known.sort(key=lambda row: -row[0])
    columns = np.array(known, dtype=np.float64).reshape(-1, 3)
    # One more wrong answer is counted: a new query may be one.
    error = (np.cumsum(columns[:, 2]) + 1) / (np.cumsum(columns[:, 1]) + 1)
    enough = np.flatnonzero(error <= 1 - certainty + 1e-9)
    lowest = max(0.5, 1 - MAX_ERROR_FACTOR * (1 - certainty))
    return max(lowest, float(columns[enough[-1], 0])) if len(enough) else None


def _first_answer(
    probabilities: Sequence[float], not_in_map: float, certainty: float, thresholds: Thresholds
) -> int | None:
    limit = thresholds.not_in_map
    for position, probability in enumerate(probabilities):
        known = thresholds.levels[position] if position < len(thresholds.levels) else None
        is_certain = probability >= (certainty if known is None else known)
        if is_certain and (position > 0 or limit is None or not_in_map <= limit):
            return position
    return None


def _probability(coefficients: Coefficients, level: CandidateLevel, shift: float = 0.0) -> float:
    design = shipped_prior().design(level.features[None])
    return float(_sigmoid(design @ np.array(coefficients) + shift)[0])


def _sigmoid(x: NDArray[np.float64]) -> NDArray[np.float64]:
    probabilities: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-np.clip(x, -30, 30)))
    return probabilities
