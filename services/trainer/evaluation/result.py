"""One answered evaluation set, with all that its files and its report say."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field
from typing import Any

from services.trainer.evaluation.against import RunComparison
from services.trainer.evaluation.measure import RetrievalMetrics
from services.trainer.evaluation.nearest import Rankings, Scores
from shared.datasets.audit import SuspectLabel
from shared.datasets.published import PublishedResult
from shared.datasets.sets import DatasetPhoto, EvaluationSet


@dataclass(frozen=True)
class EvaluationRun:
    """What answered, the same for all sets of a run."""

    name: str
    """a checkpoint's file, an extractor, a server's map, a predictions file"""
    fingerprint: str | None
    """of what decides a descriptor's value; None where nothing says it"""
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EvaluationResult:
    asked: EvaluationSet
    """Of a predictions file without lists, the database is empty."""
    ranked: Rankings
    has_scores: bool
    measured: RetrievalMetrics
    about: dict[str, Any]
    """`dimension`, `describe_ms_per_photo`, ... as far as they are known"""
    against: RunComparison | None = None
    published: tuple[PublishedResult, ...] = ()
    suspects: tuple[SuspectLabel, ...] = ()
    """confident first matches that the rule calls wrong and that lie just outside of it"""

    @property
    def file_name(self) -> str:
        """The set's name as a part of file names."""
        return re.sub(r"[^A-Za-z0-9._-]+", "_", self.asked.name)

    @property
    def scores(self) -> Scores | None:
        return self.ranked.scores if self.has_scores else None

    def match(self, query: int, rank: int) -> DatasetPhoto | None:
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
            "suspects": [asdict(suspect) for suspect in self.suspects],
        }
