"""When a place estimate answers, and at which level.

The estimate answers at the finest level whose probability reaches a threshold. The threshold of a
certainty c is the lowest for which the share c of the held-out answers, at whichever level, is
right, with one more wrong answer counted, as in conformal selection (Jin and Candes 2023). Among
the answers above a threshold are surer ones, so that it is below c.

An answer at the finest level also needs odds against "not in the map" that at most the share 1 - c
of the impostors reaches (split conformal prediction, Vovk et al. 2005). Too few samples for a
threshold leave c itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict

from shared.evaluation.place_levels import FloatArray

CERTAINTIES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.97, 0.98, 0.99, 0.995)
"""Certainties with stored thresholds; a request uses those of the next higher one."""
MAX_ERROR_FACTOR = 3.0  # of an answer's error probability over 1 - certainty
CANDIDATES = 200  # thresholds that are tried
MIN_PROBABILITY = 1e-9  # of "not in the map"; bounds the odds


class Thresholds(BaseModel):
    """When an estimate answers at one certainty."""

    model_config = ConfigDict(frozen=True)

    probability: float | None = None
    """minimum of the answered level; None: the certainty itself"""
    finest_odds: float | None = None
    """minimum ratio of the finest level's probability to that of "not in the map"; None: any"""

    def answer(
        self, probabilities: Sequence[float], not_in_map: float, certainty: float
    ) -> int | None:
        """Return the index of the finest level that is certain enough; None if none is."""
        least = certainty if self.probability is None else self.probability
        for position, probability in enumerate(probabilities):
            excluded = (
                position == 0
                and self.finest_odds is not None
                and finest_odds(probability, not_in_map) < self.finest_odds
            )
            if probability >= least and not excluded:
                return position
        return None


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutEstimate:
    """Probabilities of a sample that the model was not fitted on."""

    probabilities: Sequence[float]
    not_in_map: float
    is_right: Sequence[bool | None]
    left_out: str | None
    weight: float


def choose_thresholds(
    judged: Sequence[HeldOutEstimate], impostors: Sequence[HeldOutEstimate], certainty: float
) -> Thresholds:
    """Choose the thresholds of a certainty.

    The odds are chosen last: an answer that they move to a coarser level is at least as probable.

    Args:
        judged: The estimates of which the share `certainty` must be right if they are answered.
        impostors: The estimates of photos whose place is not in the map.
        certainty: Above 0 and below 1.
    """
    probability = _lowest_probability(judged, certainty)
    least = certainty if probability is None else probability
    odds = [
        finest_odds(s.probabilities[0], s.not_in_map) if s.probabilities[0] >= least else 0.0
        for s in impostors
    ]
    return Thresholds(probability=probability, finest_odds=_exceeded_by(odds, 1 - certainty))


def finest_odds(probability: float, not_in_map: float) -> float:
    """Return the ratio of the finest level's probability to that of "not in the map"."""
    return probability / max(not_in_map, MIN_PROBABILITY)


def _lowest_probability(estimates: Sequence[HeldOutEstimate], certainty: float) -> float | None:
    """Return the lowest probability above which the share `certainty` of the answers is right.

    It is at least the probability with MAX_ERROR_FACTOR times the error that is allowed on
    average, and 0.5: queries may be harder than the samples. None if there is no such probability.
    """
    depth = max((len(s.probabilities) for s in estimates), default=0)
    probabilities = np.full((len(estimates), depth), -1.0)
    known = np.zeros((len(estimates), depth))
    wrong = np.zeros((len(estimates), depth))
    for row, estimate in enumerate(estimates):
        probabilities[row, : len(estimate.probabilities)] = estimate.probabilities
        for position, right in enumerate(estimate.is_right):
            known[row, position] = 0.0 if right is None else estimate.weight
            wrong[row, position] = estimate.weight if right is False else 0.0
    floor = max(0.5, 1 - MAX_ERROR_FACTOR * (1 - certainty))
    for candidate in _candidates(probabilities[probabilities >= floor]):
        reached = probabilities >= candidate
        answered = np.flatnonzero(reached.any(axis=1))
        position = reached.argmax(axis=1)[answered]
        # One more wrong answer is counted: a new query may be one.
        error = (wrong[answered, position].sum() + 1) / (known[answered, position].sum() + 1)
        if error <= 1 - certainty + 1e-9:
            return float(candidate)
    return None


def _candidates(probabilities: FloatArray) -> FloatArray:
    """Return at most CANDIDATES of the probabilities, lowest first."""
    distinct = np.unique(probabilities)
    return distinct[:: max(1, -(-len(distinct) // CANDIDATES))]


def _exceeded_by(values: Sequence[float], share: float) -> float | None:
    """Return a limit that at most the share of new values reaches; None with too few values."""
    rank = int(share * (len(values) + 1) + 1e-9)
    return None if rank == 0 else float(np.nextafter(sorted(values)[-rank], np.inf))
