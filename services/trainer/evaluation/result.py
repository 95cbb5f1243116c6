"""One answered evaluation set, with all that its files and its report say."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from services.trainer.evaluation.against import Against
from services.trainer.evaluation.measure import Measured
from services.trainer.evaluation.nearest import Ranked, Scores
from shared.datasets.published import Published
from shared.datasets.sets import EvaluationSet, Shot


@dataclass(frozen=True)
class Run:
    """What answered, the same for all sets of a run."""

    name: str
    """a checkpoint's file, an extractor, a server's map, a predictions file"""
    fingerprint: str | None
    """of what decides a descriptor's value; None where nothing says it"""
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    asked: EvaluationSet
    """Of a predictions file without lists, the database is empty."""
    ranked: Ranked
    has_scores: bool
    measured: Measured
    about: dict[str, Any]
    """`dimension`, `describe_ms_per_photo`, ... as far as they are known"""
    against: Against | None = None
    published: tuple[Published, ...] = ()
    audit: tuple[dict[str, Any], ...] | None = None
    """Confident matches that the rule calls wrong, just outside of it; None where not looked for"""

    @property
    def file_name(self) -> str:
        """The set's name as a part of file names."""
        return re.sub(r"[^A-Za-z0-9._-]+", "_", self.asked.name)

    @property
    def scores(self) -> Scores | None:
        return self.ranked.scores if self.has_scores else None

    def match(self, query: int, rank: int) -> Shot | None:
        """The database photo at that rank, from 0; None where no list names it."""
        if not self.asked.database:
            return None
        return self.asked.database[int(self.ranked.indices[query, rank])]

    def match_name(self, query: int, rank: int) -> str:
        """Its name, or else its number."""
        shot = self.match(query, rank)
        return shot.name if shot else str(self.ranked.indices[query, rank])

    def as_json(self) -> dict[str, Any]:
        return {
            "fingerprint": self.asked.fingerprint,
            "protocol": self.asked.protocol,
            "rule": self.asked.rule,
            "database": len(self.asked.database) or None,
            **self.about,
            **self.measured.as_json(),
            "against": self.against.as_json() if self.against else None,
            "published": [found.as_json() for found in self.published],
            "audit": None if self.audit is None else list(self.audit),
        }


def names_of(result: Result, queries: Sequence[int]) -> list[str]:
    return [result.asked.queries[query].name for query in queries]
