"""Figures of a place model: what it answers at each certainty, and how reliable it is.

All figures are over held-out samples (cross-validation): own photos, or labelled queries if there
are enough of them to refine the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shared.evaluation.bootstrap import share_intervals
from shared.evaluation.calibration import expected_calibration_error
from shared.evaluation.places.fit import MapScores, PlaceSample, fit_place_model
from shared.evaluation.places.levels import LevelScheme
from shared.evaluation.places.probability import PlaceModel
from shared.evaluation.places.samples import OWN_PHOTO_RULE
from shared.evaluation.places.thresholds import HeldOutEstimate

REPORTED_CERTAINTIES = (0.8, 0.9, 0.95, 0.99)
RELIABILITY_BINS = 10


@dataclass(frozen=True, slots=True)
class PlaceEvaluation:
    """A fitted model and its figures, as JSON."""

    model: PlaceModel
    figures: dict[str, Any] | None
    """None with too few photos to fit a model"""


def evaluate_places(
    samples: Sequence[PlaceSample],
    labelled: Sequence[PlaceSample],
    scheme: LevelScheme,
    scores: MapScores,
) -> PlaceEvaluation:
    """Fit the model of a map (`fit_place_model`), and measure it on held-out samples."""
    fitted = fit_place_model(samples, labelled, scheme, scores)
    if not fitted.held_out:
        return PlaceEvaluation(fitted.model, None)
    positions = range(max(len(estimate.probabilities) for estimate in fitted.held_out))
    figures = {
        "source": fitted.model.source,
        "own_photos": OWN_PHOTO_RULE,
        "samples": len(fitted.held_out),
        "answers": [
            {
                **answer_figures(fitted.model, fitted.held_out, certainty),
                "impostors_at_finest_level": _mean(
                    [_answer(fitted.model, each, certainty) == 0 for each in fitted.impostors]
                ),
            }
            for certainty in REPORTED_CERTAINTIES
        ],
        "levels": [reliability_figures(fitted.held_out, position) for position in positions],
    }
    return PlaceEvaluation(fitted.model, figures)


def answer_figures(
    model: PlaceModel, estimates: Sequence[HeldOutEstimate], certainty: float
) -> dict[str, Any]:
    """Return the share of answered queries, their precision and mean level, with intervals.

    Level 0 is the finest. Precision is over answers whose truth is known at their level.
    """
    answers = [_answer(model, estimate, certainty) for estimate in estimates]
    known = [
        (index, right)
        for estimate, index in zip(estimates, answers, strict=True)
        if index is not None and (right := estimate.is_right[index]) is not None
    ]
    return {
        "certainty": certainty,
        "answered": share_with_interval([index is not None for index in answers]),
        "answered_at_finest_level": share_with_interval([index == 0 for index in answers]),
        "precision": share_with_interval([right for _, right in known]),
        "mean_level": _mean([index for index in answers if index is not None]),
    }


def reliability_figures(estimates: Sequence[HeldOutEstimate], position: int) -> dict[str, Any]:
    """Return the ECE of a level and its reliability diagram, with bins of equal size.

    Each bin has the mean of the probabilities, the observed share of right ones, and its interval.
    """
    known = sorted(
        (estimate.probabilities[position], right)
        for estimate in estimates
        if position < len(estimate.probabilities)
        and (right := estimate.is_right[position]) is not None
    )
    stated = [probability for probability, _ in known]
    observed = [right for _, right in known]
    bins = np.array_split(np.arange(len(known)), RELIABILITY_BINS)
    return {
        "level": position,
        "samples": len(known),
        "accuracy": _mean(observed),
        "calibration_error": expected_calibration_error(stated, observed) if known else None,
        "reliability": [
            {
                "stated": _mean([stated[i] for i in members]),
                "observed": share_with_interval([observed[i] for i in members]),
            }
            for members in bins
            if len(members)
        ],
    }


def _answer(model: PlaceModel, estimate: HeldOutEstimate, certainty: float) -> int | None:
    return model.answer(estimate.probabilities, estimate.not_in_map, certainty)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def share_with_interval(values: Sequence[bool]) -> dict[str, Any]:
    """Return the mean with its bootstrap interval; each query is a cluster of its own."""
    column = np.array(values, dtype=np.float64)[:, None]
    intervals = share_intervals(column, np.arange(len(column)))
    return {
        "mean": _mean(values),
        "interval": intervals[0].as_json() if intervals else None,
    }
