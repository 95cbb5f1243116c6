"""Counting what labelled queries come to: recall, accepted strangers, how good a confidence is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from shared.estimate.calibration import cross_validate
from shared.estimate.evidence import PlaceEvidence
from shared.estimate.figures import auroc, expected_calibration_error, recall_at_precision

RECALL_RANKS = (1, 5, 10)


@dataclass(slots=True)
class RecallCounter:
    """Counts queries that have a true positive, and whether one came among the first k."""

    queries: int = 0
    found: dict[int, int] = field(default_factory=lambda: dict.fromkeys(RECALL_RANKS, 0))

    def add(self, correct: Sequence[bool]) -> None:
        """One query's ranking, best first: which of them show its place."""
        self.queries += 1
        for rank in RECALL_RANKS:
            self.found[rank] += any(correct[:rank])

    def figures(self) -> dict[str, Any]:
        return {
            "queries": self.queries,
            **{f"R@{k}": ratio(found, self.queries) for k, found in self.found.items()},
        }


@dataclass(frozen=True, slots=True)
class QueryOutcome:
    """What came of one labelled query."""

    in_map: bool
    """Whether the map has a photo of its place."""
    evidence: PlaceEvidence | None
    is_correct: bool
    """Whether the estimate shows its place."""
    error_m: float | None
    same_session: bool
    """Taken within hours of the photo that it matched: no witness of another day."""
    accepted: bool | None


@dataclass(slots=True)
class LabelledQueryMetrics:
    """All labelled queries of an evaluation."""

    recall: RecallCounter = field(default_factory=RecallCounter)
    outcomes: list[QueryOutcome] = field(default_factory=list)

    def confidence_samples(self) -> list[tuple[PlaceEvidence, bool]]:
        """(evidence, was it right) of the queries of another session."""
        return [
            (o.evidence, o.is_correct)
            for o in self.outcomes
            if o.evidence is not None and not o.same_session
        ]

    def figures(self) -> dict[str, Any]:
        """Recall over queries that the map can answer; the rest over all. The confidence's figures
        are cross-validated: each query is judged by what the others have taught."""
        here = [o for o in self.outcomes if o.in_map]
        outside = [o for o in self.outcomes if not o.in_map]
        errors = [o.error_m for o in here if o.is_correct and o.error_m is not None]
        return {
            **self.recall.figures(),
            "out_of_map": len(outside),
            "same_session": sum(o.same_session for o in self.outcomes),
            "median_error_of_right_ones_m": median(errors) if errors else None,
            "accepted_in_map": ratio(sum(bool(o.accepted) for o in here), len(here)),
            "right_of_accepted": ratio(
                sum(o.is_correct for o in self.outcomes if o.accepted),
                sum(bool(o.accepted) for o in self.outcomes),
            ),
            "false_accepts": ratio(sum(bool(o.accepted) for o in outside), len(outside)),
            **self._confidence(),
        }

    def _confidence(self) -> dict[str, Any]:
        judged = self.confidence_samples()
        predicted = cross_validate(judged)
        if predicted is None:
            return {"calibration_error": None, "auroc": None, "recall_at_99_precision": None}
        right = [ok for _, ok in judged]
        findable = sum(o.in_map and not o.same_session for o in self.outcomes)
        return {
            "calibration_error": expected_calibration_error(predicted, right),
            "auroc": auroc(predicted, right),
            "recall_at_99_precision": recall_at_precision(predicted, right, findable),
        }


def ratio(part: int, whole: int) -> float | None:
    """None of nothing."""
    return part / whole if whole else None
