"""What of a ranking is asked for: the parameters that both similarity calls take."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query
from pydantic import BaseModel, ConfigDict

from services.gateway.filters import FilterDep
from shared.comparison import MOST_RERANKED
from shared.photo_filter import EVERYTHING, PhotoFilter


class Wanted(BaseModel):
    """What of the ranking is asked for. Kept with the job of a photo that is described first."""

    model_config = ConfigDict(frozen=True)

    top_k: int
    min_score: float | None = None
    photos: PhotoFilter = EVERYTHING
    word_weights: bool = True
    rerank: int | None = None
    explain: bool = False

    @property
    def closely(self) -> bool:
        """Whether an extractor has to look at what the search finds."""
        return self.rerank is not None or self.explain


TopK = Annotated[int, Query(ge=1, le=100, description="How many photos to answer.")]
MinScore = Annotated[
    float | None,
    Query(ge=-1, le=1, description="Leave out photos less similar than this."),
]
WordWeightsWanted = Annotated[
    bool,
    Query(
        alias="word_weights",
        description="Rank by the map's word weights, where it has any.",
    ),
]
Rerank = Annotated[
    int | None,
    Query(
        ge=1,
        le=MOST_RERANKED,
        description="Look at the first N photos patch by patch, and order them by what is seen.",
    ),
]
Explain = Annotated[
    bool, Query(description="Say of each photo which clusters and patches make it similar.")
]


def _read(
    photos: FilterDep,
    top_k: TopK = 10,
    min_score: MinScore = None,
    word_weights: WordWeightsWanted = True,
    rerank: Rerank = None,
    explain: Explain = False,
) -> Wanted:
    return Wanted(
        top_k=top_k,
        min_score=min_score,
        photos=photos,
        word_weights=word_weights,
        rerank=rerank,
        explain=explain,
    )


WantedDep = Annotated[Wanted, Depends(_read)]
