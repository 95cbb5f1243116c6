"""What is kept of a map's word weights, with the generation whose words they weigh."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from pydantic import BaseModel, ConfigDict

from shared.evaluation.calibration import Calibration
from shared.word_weights.training_pairs import PairSource


class Outcome(StrEnum):
    KEPT = "kept"  # searches rank by them
    NOT_KEPT = "not kept"  # they did not raise recall by more than chance would
    NOT_ENOUGH_PAIRS = "not enough pairs"  # nothing was learnt


class HeldOut(BaseModel):
    """Photos of the map, each left out and asked with what the half it is not in has taught."""

    model_config = ConfigDict(frozen=True)

    without: dict[str, Any]
    """`queries`, `R@1`, `R@5`, `R@10` by the plain cosine."""
    weighted: dict[str, Any]
    """The same of the same queries, with the weights of the other half."""
    better: int
    """Queries whose first photo is right with weights alone."""
    worse: int
    """Without them alone."""
    chance: float
    """Probability of so many better ones where weights are worth nothing."""


class WordWeights(BaseModel):
    """Stored with the generation. `pairs` are those of both halves together."""

    model_config = ConfigDict(frozen=True)

    outcome: Outcome
    reason: str
    """Why, in a sentence with the numbers."""
    taught_by: PairSource
    near_pairs: int
    far_pairs: int
    seed: int
    searchable: int
    """Photos that could be found then."""
    weights: tuple[float, ...] = ()
    """One for each word, from 0 up; of any scale. Empty where nothing was learnt."""
    held_out: HeldOut | None = None
    calibration: Calibration | None = None
    """What the scores mean that rankings with these weights have; None unless kept."""

    @property
    def applied(self) -> tuple[float, ...]:
        """The weights that searches rank by; empty unless kept."""
        return self.weights if self.outcome == Outcome.KEPT else ()


def parse_word_weights(record: dict[str, Any] | None) -> WordWeights | None:
    """What the column `Generation.word_weights` holds."""
    return None if record is None else WordWeights.model_validate(record)
