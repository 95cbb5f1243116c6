"""Whether an answer is ranked by word weights, and what its scores mean then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from shared.catalog.generations import Generation
from shared.estimate.calibration import Calibration
from shared.search_protocol import SearchHit
from shared.settings import Settings
from shared.word_weights.record import WordWeights, parse_word_weights


@dataclass(frozen=True, slots=True)
class RankingWeights:
    """What a search is asked with, and what that says of its answer."""

    generation: Generation
    record: WordWeights | None
    values: tuple[float, ...]
    """Empty: rank by the plain cosine."""

    def state(self, hits: Sequence[SearchHit]) -> str:
        """`applied`, `none` or `off`."""
        if self.values:
            return "applied" if self._ranked_by_weights(hits) else "none"
        return "off" if self.record and self.record.applied else "none"

    def calibration(self, hits: Sequence[SearchHit]) -> Calibration | None:
        """What the generation's evaluations have learnt of rankings like this one."""
        if self.values and self.record and self._ranked_by_weights(hits):
            return self.record.calibration
        stored = self.generation.calibration
        return Calibration.model_validate(stored) if stored else None

    def _ranked_by_weights(self, hits: Sequence[SearchHit]) -> bool:
        return not hits or hits[0].weighted_score is not None


def select_ranking_weights(
    generation: Generation, enabled: bool, settings: Settings
) -> RankingWeights:
    """Those of the generation, unless the call or the settings turn them off."""
    record = parse_word_weights(generation.word_weights)
    on = enabled and settings.word_weights
    return RankingWeights(generation, record, record.applied if record and on else ())
