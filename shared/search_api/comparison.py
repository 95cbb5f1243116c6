"""Looking closely at what a search has found: reranking it by its patches, and explaining it.

A compare job carries a `CompareRequest` in its params (`request`): the gateway asks, and what an
extractor finds is a `Compared` in the object store (`shared.storage.keys.comparison_key`), for as
long as the job is kept. Neither holds a vector. Imports no torch: what can be compared, the gateway
knows before it queues anything.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from uuid import UUID

from pydantic import BaseModel, ConfigDict

from shared.errors import Gone, Unprocessable
from shared.extractor_config.configs import ExtractorConfig

MAX_RERANK_CANDIDATES = (
    50  # candidates: about three batches of photos, and other queries wait so long
)


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RerankCandidate(_Message):
    """A photo that the search has found."""

    photo_id: UUID
    score: float
    """Cosine similarity in [-1, 1]."""
    weighted_score: float | None = None
    """That to the query with weighted words; None where the ranking is the plain one."""

    @property
    def ranked_by(self) -> float:
        """The score that the search has ranked by."""
        return self.score if self.weighted_score is None else self.weighted_score


class CompareRequest(_Message):
    """What is to be compared: a query with the photos that a search in one generation found.

    The query is a stored photo or the photo of a describe job. Of the `candidates`, most similar
    first, the first `rerank` are put into the order of their rerank scores, and of what comes out
    the first `explain` are explained. The generation is the job's `generation_id`.
    """

    query_photo_id: UUID | None
    query_job_id: UUID | None
    candidates: tuple[RerankCandidate, ...]
    rerank: int
    explain: int
    word_weights: tuple[float, ...] = ()
    """By which the search has ranked; () for none. What is explained is the weighted score then."""


class ClusterContribution(_Message):
    """What one cluster of the vocabulary adds to the similarity."""

    cluster: int
    share: float


class SimilarityExplanation(_Message):
    """Where a similarity comes from. Both kinds of shares add up to it within float error."""

    clusters: tuple[ClusterContribution, ...] | None
    """Of the clusters that both photos use, largest share first; None without a vocabulary."""
    rows: int
    columns: int
    """The grid of the query's patches."""
    overlay: str
    """A PNG of `columns` x `rows` pixels as a data URI, one pixel for each patch."""
    full_share: float
    """The share of a patch that is drawn without transparency: the strongest, either way."""


class RerankedCandidate(_Message):
    photo_id: UUID
    rerank_score: float | None
    """None: not among those to be reranked, or its photo could not be read."""
    explanation: SimilarityExplanation | None


class CompareResult(_Message):
    """The candidates in the order that they are to be answered in; deleted ones are left out."""

    candidates: tuple[RerankedCandidate, ...]


def check_rerankable(recipe: ExtractorConfig) -> None:
    """Unprocessable (`not_rerankable`) for an extractor that makes no local features."""
    if not recipe.has_local_features:
        raise Unprocessable(
            "not_rerankable",
            f"The extractor {recipe.name} makes one feature of a whole photo, and reranking "
            "compares patches. Leave out `rerank`, or use a map with another extractor.",
        )


def check_explainable(recipe: ExtractorConfig, spec: Mapping[str, Any] | None) -> None:
    """Unprocessable (`not_explainable`) where a similarity is no sum over patches.

    `spec` is that of the generation that answers; None where the map has none yet.
    """
    why = None
    if not recipe.has_local_features:
        why = "it makes one feature of a whole photo, and no patches"
    elif recipe.aggregator == "gem":
        why = "GeM raises the features to a power, so that no patch has a share of its own"
    elif spec is not None and spec["dimension"] != (recipe.width or 0) * (spec["clusters"] or 1):
        why = "its descriptors are projected (PCA), which mixes the clusters"
    if why is not None:
        raise Unprocessable(
            "not_explainable",
            f"Answers of the extractor {recipe.name} can't be explained: {why}. Leave out "
            "`explain`, or use a map with another extractor: VLAD without PCA, or `avg`.",
        )


def query_expired_error() -> Gone:
    """What a query's job or photo left behind is no longer kept."""
    return Gone("query_expired", "The query is no longer kept (QUERY_TTL_SECONDS). Ask again.")
