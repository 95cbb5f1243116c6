"""How probable a level must be for a place estimate to answer with it.

The threshold of a certainty c is the lowest probability for which the share c of the held-out
answers, at whichever level, is right, with one more wrong answer counted, as in conformal selection
(Jin and Candes 2023). Among the answers above a threshold are surer ones, so that it is below c.

A guarantee takes labelled queries: conformal risk control (Angelopoulos et al. 2022) bounds the
share of all queries like them that get a wrong answer. Neither holds for queries that differ from
those that it was chosen on (`have_dropped`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CERTAINTIES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.97, 0.98, 0.99, 0.995)
"""Certainties with stored thresholds; a request uses that of the next higher one."""
MAX_ERROR_FACTOR = 5.0  # of an answer's error probability over 1 - certainty
CANDIDATES = 200  # thresholds that are tried
MIN_RECENT_QUERIES = 30
MIN_DROP = 0.3  # of the share of queries below a score
FALSE_ALARMS = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutEstimate:
    """Probabilities of a sample that the model was not fitted on."""

    probabilities: Sequence[float]
    not_in_map: float
    is_right: Sequence[bool | None]
    left_out: str | None
    weight: float

    @property
    def wrong_until(self) -> float:
        """Largest threshold at which the answer to where it is, if any, is wrong."""
        finer = zip(self.probabilities[:-1], self.is_right, strict=False)
        return max((probability for probability, right in finer if right is False), default=0.0)


def guaranteed_threshold(wrong_until: Sequence[float], error: float) -> float | None:
    """Return the least threshold at which at most the share `error` of queries is answered wrongly.

    That holds on average over sets of queries like the labelled ones, of which one more is counted
    as wrong. None if they are too few.

    Args:
        wrong_until: `HeldOutEstimate.wrong_until` of each labelled query.
    """
    allowed = math.floor(error * (len(wrong_until) + 1) + 1e-9) - 1
    if allowed < 0:
        return None
    largest = sorted(wrong_until, reverse=True)[allowed:]
    return math.nextafter(largest[0], 2.0) if largest else 0.0


def have_dropped(recent: Sequence[float], known: Sequence[float], queries: int) -> bool:
    """Return whether recent queries are less similar to the map than those of its calibration.

    One-sided test of Kolmogorov and Smirnov, with at most FALSE_ALARMS.

    Args:
        recent: Score of the best photo of each recent query.
        known: Quantiles of these scores in the calibration.
        queries: Number of queries that these are of.
    """
    if len(recent) < MIN_RECENT_QUERIES or not known:
        return False
    scores = np.concatenate([recent, known])
    below = (
        np.searchsorted(np.sort(each), scores, "right") / len(each) for each in (recent, known)
    )
    drop = float(np.max(next(below) - next(below)))
    pairs = len(recent) * queries / (len(recent) + queries)
    return drop >= MIN_DROP and math.exp(-2 * drop**2 * pairs) < FALSE_ALARMS


def choose_threshold(estimates: Sequence[HeldOutEstimate], certainty: float) -> float:
    """Return the lowest probability above which the share `certainty` of the answers is right.

    It is at least the probability with MAX_ERROR_FACTOR times the error that is allowed on
    average, and 0.5: queries may be harder than the samples. Where all samples are surer, or too
    few to tell, it is at most 2 * certainty - 1: evenly distributed probabilities above that are
    the certainty in the mean. Where samples above it are wrong more often, it is the certainty.
    """
    # The last level, the whole map, is no answer to where.
    depth = max([1, *(len(s.probabilities) - 1 for s in estimates)])
    probabilities = np.full((len(estimates), depth), -1.0)
    known = np.zeros((len(estimates), depth))
    wrong = np.zeros((len(estimates), depth))
    for row, estimate in enumerate(estimates):
        finer = len(estimate.probabilities) - 1
        probabilities[row, :finer] = estimate.probabilities[:finer]
        for position, right in enumerate(estimate.is_right[:finer]):
            known[row, position] = 0.0 if right is None else estimate.weight
            wrong[row, position] = estimate.weight if right is False else 0.0
    floor = max(0.5, 1 - MAX_ERROR_FACTOR * (1 - certainty))
    unseen = max(floor, 2 * certainty - 1)
    distinct = np.unique(probabilities[probabilities >= floor])
    tried: list[float] = distinct[:: max(1, -(-len(distinct) // CANDIDATES))].tolist()
    # One more wrong answer is counted: a new query may be one.
    for candidate, more in [*((each, 1.0) for each in tried), (unseen, 0.0)]:
        reached = probabilities >= candidate
        answered = np.flatnonzero(reached.any(axis=1))
        finest = reached.argmax(axis=1)[answered]
        mistaken, judged = wrong[answered, finest].sum(), known[answered, finest].sum()
        if mistaken + more <= (1 - certainty) * (judged + more) + 1e-9:
            return min(candidate, unseen) if candidate in tried[:1] else candidate
    return certainty
