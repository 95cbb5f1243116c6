"""When a place estimate answers, and at which level.

The estimate answers at the finest level whose probability reaches a threshold. The threshold of a
certainty c is the lowest for which the share c of the held-out answers, at whichever level, is
right, with one more wrong answer counted, as in conformal selection (Jin and Candes 2023). Among
the answers above a threshold are surer ones, so that it is below c.

An answer at any level but the coarsest also needs odds against "not in the map" that at most the
share 1 - c of the impostors of each kind reaches, of those for which the level is wrong (Mondrian
conformal prediction, Vovk et al. 2005). This holds with LIMIT_CONFIDENCE over the choice of the
impostors, not on average (Vovk 2012), so that it takes n impostors with c^n <= 1 - LIMIT_CONFIDENCE
(59 for c = 0.95): with fewer, as in a map of one place, the level is never the answer. Too few
samples for a threshold leave c itself.

A query shows a place of the map if its probability of "not in the map" is below a limit, below
which at most the share FALSE_ACCEPT_RATE of the impostors of each kind is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist

import numpy as np
from pydantic import BaseModel, ConfigDict

from shared.evaluation.places.levels import FloatArray

CERTAINTIES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.97, 0.98, 0.99, 0.995)
"""Certainties with stored thresholds; a request uses those of the next higher one."""
MAX_ERROR_FACTOR = 3.0  # of an answer's error probability over 1 - certainty
CANDIDATES = 200  # thresholds that are tried
FALSE_ACCEPT_RATE = 0.05  # of queries outside the map that are said to be in it
LIMIT_CONFIDENCE = 0.95  # that no more impostors exceed a limit than are allowed
MIN_PROBABILITY = 1e-9  # of "not in the map"; bounds the odds
UNREACHABLE_ODDS = 2 / MIN_PROBABILITY


class Thresholds(BaseModel):
    """When an estimate answers at one certainty."""

    model_config = ConfigDict(frozen=True)

    probability: float | None = None
    """minimum of the answered level; None: the certainty itself"""
    odds: tuple[float, ...] = ()
    """minimum ratio of a level's probability to that of "not in the map", by position, finest
    first; further levels have none"""

    def answer(
        self, probabilities: Sequence[float], not_in_map: float, certainty: float
    ) -> int | None:
        """Return the index of the finest level that is certain enough; None if none is."""
        least = certainty if self.probability is None else self.probability
        for position, probability in enumerate(probabilities):
            least_odds = self.odds[position] if position < len(self.odds) else 0.0
            if probability >= least and _odds_in_map(probability, not_in_map) >= least_odds:
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
    """
    probability = _lowest_probability(judged, certainty)
    least = certainty if probability is None else probability
    depth = max((len(s.probabilities) for s in [*judged, *impostors]), default=0)
    odds = tuple(
        _least_odds(impostors, position, least, 1 - certainty)
        for position in range(max(min(depth, 1), depth - 1))
    )
    return Thresholds(probability=probability, odds=odds)


def choose_in_map_limit(impostors: Sequence[HeldOutEstimate]) -> float | None:
    """Choose the limit that "not in the map" must stay below for a query in the map.

    At most the share FALSE_ACCEPT_RATE of new impostors of each kind stays below it, on average
    over the choice of the impostors (conformal prediction, Vovk et al. 2005).

    Returns:
        The limit; None if no kind has the 19 impostors that tell one in twenty.
    """
    kinds: dict[str | None, list[float]] = defaultdict(list)
    for impostor in impostors:
        kinds[impostor.left_out].append(impostor.not_in_map)
    ranks = {kind: int((len(kinds[kind]) + 1) * FALSE_ACCEPT_RATE + 1e-9) for kind in kinds}
    limits = [sorted(kinds[kind])[rank - 1] for kind, rank in ranks.items() if rank > 0]
    return min(limits, default=None)


def _odds_in_map(probability: float, not_in_map: float) -> float:
    """Return the ratio of a level's probability to that of "not in the map"."""
    return probability / max(not_in_map, MIN_PROBABILITY)


def _least_odds(
    impostors: Sequence[HeldOutEstimate], position: int, least: float, share: float
) -> float:
    """Return the odds that at most a share of the impostors of each kind reaches at a level.

    UNREACHABLE_ODDS with too few impostors for which the level is wrong.
    """
    kinds: dict[str | None, list[float]] = defaultdict(list)
    for impostor in impostors:
        if position < len(impostor.is_right) and impostor.is_right[position] is False:
            probability = impostor.probabilities[position]
            odds = _odds_in_map(probability, impostor.not_in_map)
            kinds[impostor.left_out].append(odds if probability >= least else 0.0)
    most = max(map(len, kinds.values()), default=0)
    if (1 - share) ** most > 1 - LIMIT_CONFIDENCE:
        return UNREACHABLE_ODDS
    return max(_exceeded_by(odds, share) for odds in kinds.values())


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


def _exceeded_by(values: Sequence[float], share: float) -> float:
    """Return a limit that at most the share of new values reaches, with LIMIT_CONFIDENCE.

    The number of values above the quantile of the share is binomial; its lower bound is that of
    the normal approximation. Too few values give a limit above all of them.
    """
    count = len(values)
    margin = NormalDist().inv_cdf(LIMIT_CONFIDENCE) * sqrt(count * share * (1 - share))
    rank = max(1, int(count * share - margin))
    return float(np.nextafter(sorted(values)[-rank], np.inf))
