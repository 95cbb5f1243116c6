"""Published figures, each with the set that it was measured on.

A figure is comparable only where protocol and fingerprint are the same: the same photos, the same
positives, the same queries counted. Reports of "92.2 instead of 95.1" mostly compare two sets of
one name. The lists of the published sets can't be shipped, so a fingerprint joins this table when
someone has the set and has checked it against the publication; until then nothing is placed beside
a result.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from shared.datasets.shots import EvaluationSet


@dataclass(frozen=True, slots=True)
class PublishedResult:
    protocol: str
    fingerprint: str
    """`EvaluationSet.fingerprint` of the very set"""
    method: str
    recall: dict[int, float]
    """by k, 0 to 1"""
    source: str

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"recall": {str(k): share for k, share in self.recall.items()}}


PUBLISHED_RESULTS: tuple[PublishedResult, ...] = ()


def find_published_results(
    evaluation: EvaluationSet, known: tuple[PublishedResult, ...] = PUBLISHED_RESULTS
) -> tuple[PublishedResult, ...]:
    """What has been published of exactly this set."""
    return tuple(
        found
        for found in known
        if (found.protocol, found.fingerprint) == (evaluation.protocol, evaluation.fingerprint)
    )
