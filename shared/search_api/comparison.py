"""Messages of compare jobs: reranking search results by local features, and explaining them.

The gateway stores a `CompareRequest` in the job's params (`request`). The extractor writes a
`CompareResult` to the object store (`shared.storage.keys.comparison_key`), where it stays as long
as the job does. Neither contains a vector. The module imports no torch: the gateway checks whether
a comparison is possible before it queues the job.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field

from shared.errors import Gone, Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.search_api.protocol import SearchHit

MAX_RERANK_CANDIDATES = 50  # about three batches of photos, for which other queries have to wait


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CompareRequest(_Message):
    """Request to compare a query with the hits of a search in one generation.

    The query is a stored photo or the photo of a describe job. The first `rerank` of the
    `candidates`, which are sorted by similarity, are sorted by their rerank scores; the first
    `explain` of the outcome are explained. The generation is the job's `generation_id`.
    """

    query_photo_id: UUID | None
    query_job_id: UUID | None
    candidates: tuple[SearchHit, ...]
    rerank: int
    explain: int
    word_weights: tuple[float, ...] = ()
    """Weights that the search ranked by, or (); with weights, the weighted score is explained."""


class ClusterContribution(_Message):
    cluster: int = Field(description="index in the vocabulary of the generation, from 0")
    share: float = Field(description="its contribution to the similarity")


class SimilarityExplanation(_Message):
    """Contributions of clusters and patches to a similarity; they add up to it."""

    clusters: tuple[ClusterContribution, ...] | None = Field(
        description="clusters that both photos use, largest share first; null without a vocabulary"
    )
    rows: int = Field(description="rows of the query's patch grid")
    columns: int = Field(description="columns of the query's patch grid")
    overlay: str = Field(
        description="data URI of a PNG with one pixel per patch of the query: orange patches "
        "raise the similarity, violet ones lower it, transparent ones do neither. Scale it to the "
        "query photo without interpolation"
    )
    full_share: float = Field(description="the share at which a patch is drawn fully opaque")


class RerankedCandidate(_Message):
    """A candidate with its rerank score and explanation."""

    photo_id: UUID
    rerank_score: float | None
    """None if it was not to be reranked, or its photo could not be read."""
    explanation: SimilarityExplanation | None


class CompareResult(_Message):
    """Result of a comparison: the candidates in their final order, without deleted ones."""

    candidates: tuple[RerankedCandidate, ...]


def check_rerankable(config: ExtractorConfig) -> None:
    """Raise Unprocessable (`not_rerankable`) for an extractor without local features."""
    if not config.has_local_features:
        raise Unprocessable(
            "not_rerankable",
            f"The extractor {config.name} computes one feature per photo, but reranking compares "
            "patches. Leave out `rerank`, or use a map with another extractor.",
        )


def check_explainable(config: ExtractorConfig, spec: Mapping[str, Any] | None) -> None:
    """Raise Unprocessable (`not_explainable`) if a similarity is not a sum over patches.

    Args:
        spec: Spec of the active generation; None if the map has none yet.
    """
    reason = None
    if not config.has_local_features:
        reason = "it computes one feature per photo, and no patches"
    elif config.aggregator == "gem":
        reason = "GeM pooling raises features to a power, so a similarity is not a sum over patches"
    elif spec is not None and spec["dimension"] != (config.width or 0) * (spec["clusters"] or 1):
        reason = "its descriptors are projected (PCA), which mixes the clusters"
    if reason is not None:
        raise Unprocessable(
            "not_explainable",
            f"Results of the extractor {config.name} can't be explained: {reason}. Leave out "
            "`explain`, or use a map with another extractor: VLAD without PCA, or `avg`.",
        )


def query_expired_error() -> Gone:
    """Error for a query whose photo or descriptor has expired."""
    return Gone("query_expired", "The query has expired: it is kept for an hour. Send it again.")
