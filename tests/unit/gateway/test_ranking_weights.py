"""Ranking weights of a search request, and how the response reports them."""

from __future__ import annotations

from typing import Any

import pytest

from services.gateway.similarity.execute import select_ranking_weights
from shared.catalog.generations import Generation
from shared.evaluation.places.probability import PlaceModel
from shared.ids import new_id
from shared.search_api.protocol import SearchHit
from shared.word_weights.record import Outcome, WordWeights
from shared.word_weights.training_pairs import PairSource

PLAIN = SearchHit(photo_id=new_id(), score=0.5)
WEIGHTED = SearchHit(photo_id=new_id(), score=0.5, weighted_score=0.7)


def model(limit: float) -> PlaceModel:
    return PlaceModel(source="own_photos", in_map_limit=limit)


def generation(outcome: Outcome | None) -> Generation:
    """One whose plain limit is 0.1, and 0.2 with its weights."""
    record: dict[str, Any] | None = None
    if outcome is not None:
        record = WordWeights(
            outcome=outcome,
            reason="",
            taught_by=PairSource.COORDINATES,
            near_pairs=100,
            far_pairs=100,
            seed=0,
            searchable=100,
            weights=(1.0, 0.0),
            calibration=model(0.2),
        ).model_dump(mode="json")
    return Generation(calibration=model(0.1).model_dump(mode="json"), word_weights=record)


@pytest.mark.parametrize(
    ("outcome", "expected", "first", "state", "limit"),
    [
        (Outcome.KEPT, True, WEIGHTED, "applied", 0.2),
        (Outcome.KEPT, True, None, "applied", 0.2),
        (Outcome.KEPT, True, PLAIN, "none", 0.1),  # the query has none of the words
        (Outcome.KEPT, False, PLAIN, "off", 0.1),
        (Outcome.NOT_KEPT, True, PLAIN, "none", 0.1),
        (Outcome.NOT_KEPT, False, PLAIN, "none", 0.1),
        (None, True, PLAIN, "none", 0.1),
    ],
)
def test_answers_say_whether_weights_rank_and_are_judged_accordingly(
    outcome: Outcome | None,
    expected: bool,
    first: SearchHit | None,
    state: str,
    limit: float,
) -> None:
    chosen = select_ranking_weights(generation(outcome), expected)
    hits = [first] if first else []
    assert chosen.values == ((1.0, 0.0) if outcome == Outcome.KEPT and expected else ())
    assert chosen.state(hits) == state
    judged_by = chosen.calibration(hits)
    assert judged_by is not None
    assert judged_by.in_map_limit == limit
