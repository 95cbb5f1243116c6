"""What one drain of the extractor's worker did."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

from services.extractor.publish import PublishResult


@dataclass(slots=True)
class DrainStats:
    """What one drain did: this is what the operator sees."""

    maps: set[str] = field(default_factory=set)
    claimed: int = 0
    succeeded: int = 0
    failed: int = 0
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    interrupted: bool = False
    """It ended before the work did."""

    def merge(self, other: DrainStats) -> None:
        """Count what another one has counted, too."""
        self.maps |= other.maps
        self.claimed += other.claimed
        self.succeeded += other.succeeded
        self.failed += other.failed
        for stage, took in other.seconds.items():
            self.seconds[stage] += took

    def add_batch(self, outcome: PublishResult, seconds: dict[str, float]) -> None:
        """Count what a batch came to, and the time of its stages."""
        self.succeeded += outcome.succeeded
        self.failed += outcome.failed
        for stage, took in seconds.items():
            self.seconds[stage] += took

    def as_dict(self) -> dict[str, Any]:
        """For logs and for Flower."""
        return {
            "maps": sorted(self.maps),
            "claimed": self.claimed,
            "succeeded": self.succeeded,
            "failed": self.failed,
            "seconds": {stage: round(took, 3) for stage, took in self.seconds.items()},
        }
