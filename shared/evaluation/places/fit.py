"""Fits the probabilities of a map's place estimates to its own photos and labelled queries.

Each regression is fitted by maximum a posteriori. The Gaussian prior is centred on the shipped
coefficients: a small map stays near them, a large one follows its own photos.

The samples are the map's own photos, each searched without itself, and *impostors*: the same photos
searched as if the map had no photo of a place that shows them. Levels are conditional on "in this
map": they learn nothing from impostors, which look like queries of another season, and from a
wrong sample as much as the map probably shows its place. Labelled queries, if there are enough,
refine the coefficients, with those of the own photos as the prior. Thresholds are chosen on
cross-validated predictions, where impostors have the total weight `UNMAPPED_SHARE`: that share of
queries of places without a photo is assumed.

An own photo that is alone at its place teaches nothing about "in the map": searched without itself,
it is an impostor.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shared.evaluation.places.levels import CandidateLevel, FloatArray, LevelScheme
from shared.evaluation.places.probability import (
    ELSEWHERE_SHARE,
    MIN_LABELLED_QUERIES,
    UNMAPPED_SHARE,
    Background,
    Coefficients,
    Elsewhere,
    MapExtent,
    PlaceModel,
    PlacePrior,
    extended,
    shipped_prior,
    sigmoid,
)
from shared.evaluation.places.thresholds import CERTAINTIES, HeldOutEstimate, choose_threshold

MIN_OWN_PHOTOS = 20
PRIOR_PRECISION = 2.0  # of each coefficient of a standardised feature
OWN_PRECISION = 20.0  # the same for own photos, which do not show how queries of other days differ
ELSEWHERE_PRECISION = 1.0  # what is known of another extractor says less
NEWTON_STEPS = 50
FOLDS = 5
QUANTILES = 101  # of the scores of best photos


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
    is_alone: bool = False
    """whether no other photo that the sample may find shows its place"""


@dataclass(frozen=True, slots=True)
class MapScores:
    """What is known of a map's scores and size before its model is fitted."""

    spread: float
    """unit of score differences of the samples' features"""
    background: Background
    extent: MapExtent = field(default_factory=MapExtent)
    extractor: str = ""
    """of a map with a vocabulary of its own, whose foreign scores may be known; else empty"""


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
    scores: MapScores,
) -> FittedPlaceModel:
    """Fit the model of a map.

    Args:
        samples: The map's own photos and their impostors.
        labelled: Labelled queries, taken in another session than the photos that they match.

    Returns:
        The model; the prior with fewer than MIN_OWN_PHOTOS own photos and fewer than
        MIN_LABELLED_QUERIES labelled queries.
    """
    own = sum(sample.left_out is None for sample in samples)
    if len(labelled) < MIN_LABELLED_QUERIES:
        labelled = ()
    if own < MIN_OWN_PHOTOS and not labelled:
        return FittedPlaceModel(PlaceModel(extent=scores.extent), [], [])
    own_held_out, labelled_held_out = _predict_held_out(samples, labelled, scheme, scores)
    impostors = [s for s in own_held_out if s.left_out is not None]
    judged = labelled_held_out or own_held_out
    thresholds = tuple(choose_threshold(judged, certainty) for certainty in CERTAINTIES)
    fitted = _fit_coefficients(samples, labelled, scheme, scores)
    best = [s.levels[0].best_score for s in labelled or samples if s.left_out is None]
    quantiles = np.quantile(best, np.linspace(0, 1, QUANTILES)) if best else np.zeros(0)
    model = fitted.model_copy(
        update={
            "thresholds": thresholds,
            "wrong_until": tuple(each.wrong_until for each in labelled_held_out),
            "best_scores": tuple(quantiles.round(4).tolist()),
        }
    )
    mistaken = [[_is_mistaken(model, s, each) for s in impostors] for each in CERTAINTIES]
    if impostors:
        model = model.model_copy(update={"mistaken": tuple(np.mean(mistaken, axis=1).tolist())})
    in_map = labelled_held_out or [s for s in own_held_out if s.left_out is None]
    return FittedPlaceModel(model, in_map, impostors)


def _is_mistaken(model: PlaceModel, estimate: HeldOutEstimate, certainty: float) -> bool:
    answer = model.answer(estimate.probabilities, estimate.not_in_map, certainty)
    return answer is not None and estimate.is_right[answer] is False


def _fit_coefficients(
    samples: Sequence[PlaceSample],
    labelled: Sequence[PlaceSample],
    scheme: LevelScheme,
    scores: MapScores,
) -> PlaceModel:
    prior, elsewhere = shipped_prior(), _fit_elsewhere(samples, scores)
    positions = max((len(sample.levels) for sample in [*samples, *labelled]), default=0)
    levels = []
    for position in range(positions):
        own = _level_table([s for s in samples if s.left_out is None], position, elsewhere)
        width = own.features.shape[-1] if len(own.target) else 0
        fitted = fit_map_estimate(own, prior.level_coefficients(width), precision=OWN_PRECISION)
        levels.append(fit_map_estimate(_level_table(labelled, position, elsewhere), fitted))
    return PlaceModel(
        source="labelled_queries" if labelled else "own_photos",
        scheme=scheme,
        spread=scores.spread,
        levels=tuple(levels),
        missing_place=fit_map_estimate(missing_place_table(samples), prior.missing_place),
        elsewhere=elsewhere,
        extent=scores.extent,
        own_photos=sum(sample.left_out is None for sample in samples),
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
        return cls(*(np.array(column, dtype=np.float64) for column in columns))


def _level_table(
    samples: Sequence[PlaceSample], position: int, elsewhere: Elsewhere
) -> RegressionTable:
    def weight(sample: PlaceSample) -> float:
        wrong = sample.is_right[position] is False
        return 1 - wrong * elsewhere.probability(sample.levels, ELSEWHERE_SHARE)

    return RegressionTable.of_rows(
        (sample.levels[position].features, right, weight(sample))
        for sample in samples
        if position < len(sample.levels) and (right := sample.is_right[position]) is not None
    )


def missing_place_table(
    samples: Sequence[PlaceSample],
    describe: Callable[[Sequence[CandidateLevel]], FloatArray] = lambda levels: levels[0].features,
) -> RegressionTable:
    """Return the samples of a missing place, half of them impostors by weight."""
    samples = [s for s in samples if s.left_out is not None or not s.is_alone]
    return RegressionTable.of_rows(
        (describe(sample.levels), sample.left_out is not None, weight)
        for sample, weight in zip(samples, sample_weights(samples, 0.5), strict=True)
    )


def _fit_elsewhere(samples: Sequence[PlaceSample], scores: MapScores) -> Elsewhere:
    """Return the log-odds of photos of elsewhere.

    Where the scores of foreign photos are not known, impostors of each kind stand for them: they
    are more similar to the map, so that too few queries are answered rather than too many. What
    would speak for elsewhere as it grows is left out, or what resembles nothing were in the map.
    """
    prior = shipped_prior()
    if scores.extractor and (known := prior.elsewhere.get(scores.extractor)):
        return known.of_map(scores.background)
    other = prior.elsewhere[""].of_map(scores.background)
    table = missing_place_table(samples, other.features)
    if not 0 < table.target.sum() < len(table.target):
        return other
    plain = PlacePrior(means=(), scales=(), level=(), missing_place=())
    name = "coefficients" if table.features.shape[1] == 2 else "matched"
    used = np.ones(1 + table.features.shape[1])
    while True:
        counted = replace(table, features=table.features * used[1:])
        center = tuple((np.array(getattr(other, name)) * used).tolist())
        fitted = fit_map_estimate(counted, center, plain, ELSEWHERE_PRECISION)
        if max(fitted[1:]) <= 0:
            return other.model_copy(update={name: fitted})
        used[1:][np.array(fitted[1:]) > 0] = 0


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
    table: RegressionTable,
    center: Coefficients,
    prior: PlacePrior | None = None,
    precision: float = PRIOR_PRECISION,
) -> Coefficients:
    """Fit a logistic regression by maximum a posteriori, with Newton's method.

    Args:
        table: The samples; without any, the result is `center`.
        center: Mean of the Gaussian prior of the coefficients.
        prior: Standardises the features; the shipped prior by default.
        precision: Precision of the Gaussian prior of each coefficient.
    """
    if not len(table.target):
        return center
    design = (prior or shipped_prior()).design(table.features)
    mean = extended(center, design.shape[1])
    beta = mean.copy()

    def loss(beta: FloatArray) -> float:
        margin = np.where(table.target > 0.5, 1, -1) * (design @ beta)
        fit = float(table.weights @ np.logaddexp(0.0, -margin))
        return fit + precision / 2 * float(((beta - mean) ** 2).sum())

    for _ in range(NEWTON_STEPS):
        probability = sigmoid(design @ beta)
        gradient = design.T @ (table.weights * (table.target - probability))
        gradient -= precision * (beta - mean)
        variance = table.weights * probability * (1 - probability)
        hessian = (design.T * variance) @ design + precision * np.eye(len(beta))
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
    scores: MapScores,
) -> tuple[list[HeldOutEstimate], list[HeldOutEstimate]]:
    """Predict the samples and the labelled queries by cross-validation."""
    predicted: tuple[list[HeldOutEstimate], list[HeldOutEstimate]] = ([], [])
    for fold in range(FOLDS):
        own, queries = (
            [s for s in each if s.photo % FOLDS != fold] for each in (samples, labelled)
        )
        model = _fit_coefficients(own, queries, scheme, scores)
        for each, into in zip((samples, labelled), predicted, strict=True):
            held_out = [s for s in each if s.photo % FOLDS == fold]
            weights = sample_weights(held_out, UNMAPPED_SHARE)
            for sample, weight in zip(held_out, weights, strict=True):
                levels = model.extent.end_levels(sample.levels)
                right = [*sample.is_right[: len(levels) - 1], True]
                probabilities = model.probabilities(levels)
                into.append(HeldOutEstimate(*probabilities, right, sample.left_out, weight))
    return predicted
