"""Record of a map's word weights, stored with the generation of their vocabulary."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from pydantic import BaseModel, ConfigDict

from shared.evaluation.places.probability import PlaceModel
from shared.word_weights.training_pairs import PairSource


class Outcome(StrEnum):
    """Result of fitting word weights."""

    KEPT = "kept"  # searches use the weights
    NOT_KEPT = "not kept"  # recall did not improve significantly
    NOT_ENOUGH_PAIRS = "not enough pairs"  # no weights were fitted


class HeldOut(BaseModel):
    """Two-fold cross-validation: leave-one-out queries with the weights of the other half."""

    model_config = ConfigDict(frozen=True)

    without: dict[str, Any]
    """`queries`, `R@1`, `R@5`, `R@10` of the unweighted cosine"""
    weighted: dict[str, Any]
    """the same metrics of the same queries with weights"""
    better: int
    """number of queries that are correct at rank 1 only with weights"""
    worse: int
    """number of queries that are correct at rank 1 only without weights"""
    chance: float
    """p-value of the one-sided sign test"""


class WordWeights(BaseModel):
    """Word weights of a generation. Numbers of pairs are those of both halves together."""

    model_config = ConfigDict(frozen=True)

    outcome: Outcome
    reason: str
    """explanation of the outcome, with its numbers"""
    taught_by: PairSource
    """what same-place pairs were determined by"""
    near_pairs: int
    """number of same-place pairs"""
    far_pairs: int
    """number of different-place pairs"""
    seed: int
    searchable: int
    """number of searchable photos at the time of fitting"""
    weights: tuple[float, ...] = ()
    """one per word, 0 or more, of any scale; empty if none were fitted"""
    held_out: HeldOut | None = None
    """cross-validation; None if no weights were fitted"""
    calibration: PlaceModel | None = None
    """place model of weighted rankings; None unless the outcome is `kept`"""

    @property
    def applied(self) -> tuple[float, ...]:
        """The weights that searches use; empty unless the outcome is `kept`."""
        return self.weights if self.outcome == Outcome.KEPT else ()


def parse_word_weights(record: dict[str, Any] | None) -> WordWeights | None:
    """Parse the value of the column `Generation.word_weights`."""
    return None if record is None else WordWeights.model_validate(record)
