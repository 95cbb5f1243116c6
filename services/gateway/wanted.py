"""What of a ranking is asked for: the parameters that both similarity calls take."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query
from pydantic import BaseModel, ConfigDict

from services.gateway.filters import FilterDep
from shared.comparison import MAX_RERANK_CANDIDATES
from shared.photo_filter import NO_FILTER, PhotoFilter
from shared.search_protocol import Mode


class SearchParams(BaseModel):
    """What of the ranking is asked for. Kept with the job of a photo that is described first."""

    model_config = ConfigDict(frozen=True)

    top_k: int
    min_score: float | None = None
    photos: PhotoFilter = NO_FILTER
    word_weights: bool = True
    rerank: int | None = None
    explain: bool = False
    mode: Mode = Mode.AUTO
    most_rows: int | None = None
    most_seconds: float | None = None

    @property
    def needs_comparison(self) -> bool:
        """Whether an extractor has to look at what the search finds."""
        return self.rerank is not None or self.explain


TopK = Annotated[int, Query(ge=1, le=100, description="How many photos to answer.")]
MinScore = Annotated[
    float | None,
    Query(ge=-1, le=1, description="Leave out photos less similar than this."),
]
ModeParam = Annotated[
    Mode,
    Query(
        alias="mode",
        description="How to search: `auto`, whichever reads least; `dense`, every row; "
        "`deterministic`, leaving nothing to chance. The photos are the same.",
    ),
]
MaxRows = Annotated[
    int | None,
    Query(ge=0, description="End the search once so many rows were read, and say so."),
]
MaxSeconds = Annotated[
    float | None,
    Query(gt=0, description="End the search after so long, and say so."),
]
UseWordWeights = Annotated[
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
        le=MAX_RERANK_CANDIDATES,
        description="Look at the first N photos patch by patch, and order them by what is seen.",
    ),
]
Explain = Annotated[
    bool, Query(description="Say of each photo which clusters and patches make it similar.")
]


def parse_search_params(
    photos: FilterDep,
    top_k: TopK = 10,
    min_score: MinScore = None,
    word_weights: UseWordWeights = True,
    rerank: Rerank = None,
    explain: Explain = False,
    mode: ModeParam = Mode.AUTO,
    most_rows: MaxRows = None,
    most_seconds: MaxSeconds = None,
) -> SearchParams:
    return SearchParams(
        top_k=top_k,
        min_score=min_score,
        photos=photos,
        word_weights=word_weights,
        rerank=rerank,
        explain=explain,
        mode=mode,
        most_rows=most_rows,
        most_seconds=most_seconds,
    )


SearchParamsDep = Annotated[SearchParams, Depends(parse_search_params)]
