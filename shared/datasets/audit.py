"""Answers that a ground truth calls wrong although they may be right.

A confident first match just outside the rule, 30 m away say, or in the right spot but looking
another way, often shows the place: whoever made the ground truth should look at it. Users of
published sets have found whole figures wrong for such labels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.datasets.distances import pairwise_distances_m
from shared.datasets.ground_truth import heading_differences
from shared.datasets.rules import PositiveRule, parse_rule
from shared.datasets.shots import DatasetPhoto, EvaluationSet, Indices
from shared.errors import InvalidRequest

MAX_RULE_MULTIPLE = 4.0
"""How far outside of the rule a match is still worth a look."""


@dataclass(frozen=True, slots=True)
class SuspectLabel:
    """A query whose confident first match counts as wrong."""

    query: int
    """index"""
    database: int
    query_name: str
    database_name: str
    score: float | None
    metres: float | None
    """between them; None where one has no position"""
    degrees: float | None
    """between the ways they look, 0 to 180; None where one has no heading"""


def find_suspect_labels(
    evaluation: EvaluationSet,
    ranked: Indices,
    scores: NDArray[np.float32] | None = None,
    *,
    min_score: float | None = None,
) -> list[SuspectLabel]:
    """First matches that are no positives, are confident, and lie just outside the set's rule.

    `ranked` is (queries, k) database indices and `scores` (queries, k), the higher the better. A
    match is confident from `min_score` on; left out, from the median score of the first matches
    that are right. Without scores every first match is. "Just outside" is TIMES_THE_RULE its
    metres or frames, whatever the heading; where the set's rule is unknown or of labels, its 25 m
    count. Most confident first.

    Raises InvalidRequest (`predictions_of_other_queries`).
    """
    if len(ranked) != len(evaluation.queries) or (
        scores is not None and len(scores) != len(ranked)
    ):
        raise InvalidRequest(
            "predictions_of_other_queries",
            f"There are {len(ranked)} predictions for {len(evaluation.queries)} queries"
            + ("." if scores is None else f", with {len(scores)} rows of scores."),
        )
    if not ranked.size:
        return []
    first = ranked[:, 0]
    right = np.array(
        [found in positives for found, positives in zip(first, evaluation.positives, strict=True)],
        dtype=bool,
    )
    confident = ~right
    if scores is not None:
        if min_score is None:
            min_score = float(np.median(scores[right, 0])) if right.any() else -np.inf
        confident &= scores[:, 0] >= min_score
    suspects = _near(evaluation, first, np.flatnonzero(confident), scores)
    return sorted(suspects, key=lambda one: (-(one.score or 0.0), one.query))


def _near(
    evaluation: EvaluationSet, first: Indices, asked: Indices, scores: NDArray[np.float32] | None
) -> list[SuspectLabel]:
    queries = [evaluation.queries[number] for number in asked]
    matches = [evaluation.database[number] for number in first[asked]]
    rule = _rule_of(evaluation)
    metres = pairwise_distances_m(queries, matches)
    suspects = []
    for number, query, match, away in zip(asked.tolist(), queries, matches, metres, strict=True):
        if _is_just_outside(rule, query, match, float(away)):
            suspects.append(
                SuspectLabel(
                    number,
                    int(first[number]),
                    query.name,
                    match.name,
                    None if scores is None else float(scores[number, 0]),
                    None if np.isnan(away) else float(away),
                    _degrees(query, match),
                )
            )
    return suspects


def _is_just_outside(
    rule: PositiveRule, query: DatasetPhoto, match: DatasetPhoto, metres: float
) -> bool:
    if rule.kind == "frames":
        if query.frame is None or match.frame is None:
            return False
        return abs(query.frame - match.frame) <= MAX_RULE_MULTIPLE * max(rule.frames, 1)
    return metres <= MAX_RULE_MULTIPLE * rule.radius_m  # never of NaN


def _rule_of(evaluation: EvaluationSet) -> PositiveRule:
    try:
        return parse_rule(evaluation.rule)
    except InvalidRequest:  # a ground truth of unknown making, named after its file
        return PositiveRule("radius")


def _degrees(query: DatasetPhoto, match: DatasetPhoto) -> float | None:
    if query.heading is None or match.heading is None:
        return None
    return float(heading_differences(np.array([match.heading]), query.heading)[0])
