"""Reranking and explanations of similarity searches: `rerank=N` and `explain=true`.

The hits of the search become a compare job of the highest priority, with the rest of the response
in its params; an extractor compares them with the query patch by patch. The request waits for a
while for the job. Its result is joined with live photos again, so that photos deleted in the
meantime are not returned.
"""

from __future__ import annotations

from uuid import UUID

from pydantic import BaseModel, ConfigDict
from sqlalchemy.orm import Session

from services.gateway.dependencies import GatewayContext
from services.gateway.idempotency import IdempotentRequest
from services.gateway.schemas import SimilarityResponse, SimilarPhotoResponse
from services.gateway.similarity.execute import (
    SimilarityQuery,
    run_similarity_search,
    write_to_map,
)
from services.gateway.similarity.search_params import SearchParams
from shared.catalog.generations import active_generation
from shared.catalog.maps import Search, get_map
from shared.catalog.photos import get_live_photos
from shared.errors import NotFound
from shared.ids import new_id
from shared.jobs import Job, JobKind, Priority
from shared.jobs.wakeups import WakeupQueue
from shared.search_api.comparison import (
    CompareRequest,
    CompareResult,
    check_explainable,
    check_rerankable,
    query_expired_error,
)
from shared.storage.keys import comparison_key

COMPARE_JOB_PARAM = "compare_job_id"
"""Params key of a describe job: the id of the compare job of its photo."""


class CompareJobParams(BaseModel):
    """Params of a compare job: the request to the extractor, and the rest of the response."""

    model_config = ConfigDict(frozen=True)

    request: CompareRequest
    top_k: int
    frame: SimilarityResponse
    match_probabilities: dict[UUID, float] = {}


def check_comparison_supported(
    gateway: GatewayContext, map_name: str, search_params: SearchParams
) -> None:
    """Check that the extractor of the map supports the requested comparison.

    Raises:
        Unprocessable: `not_rerankable`, `not_explainable`.
    """
    if not search_params.needs_comparison:
        return
    with gateway.catalog.read() as session:
        map_ = get_map(session, map_name)
        generation = active_generation(session, map_.id)
    extractor = generation.extractor if generation else map_.extractor
    config = gateway.settings.extractor_config(extractor)
    if search_params.rerank is not None:
        check_rerankable(config)
    if search_params.explain:
        check_explainable(config, generation.spec if generation else None)


def start_comparison_of_stored_photo(
    gateway: GatewayContext,
    query: SimilarityQuery,
    search_params: SearchParams,
    idempotent: IdempotentRequest,
) -> Job:
    """Search with a stored photo and queue a compare job for the hits."""
    job, history = _build_compare_job(gateway, query, search_params, None)
    with write_to_map(gateway, query.map) as session:
        session.add_all(history)
        idempotent.store_job_response(session, job)
    gateway.wakeups.send(WakeupQueue.QUERY)
    return job


def start_comparison_of_query_photo(
    gateway: GatewayContext, describe_job: Job, query: SimilarityQuery, search_params: SearchParams
) -> Job:
    """Return the compare job of a described query photo, and create it if there is none yet."""
    with gateway.catalog.read() as session:
        existing = _find_compare_job(session, describe_job)
    if existing is not None:
        return existing
    job, history = _build_compare_job(gateway, query, search_params, describe_job.id)
    with write_to_map(gateway, query.map) as session:
        current = session.get(Job, describe_job.id, with_for_update=True, populate_existing=True)
        if current is None:
            raise query_expired_error()
        existing = _find_compare_job(session, current)
        if existing is not None:  # created by a concurrent request
            return existing
        current.params = {**current.params, COMPARE_JOB_PARAM: str(job.id)}
        session.add_all([job, *history])
    gateway.wakeups.send(WakeupQueue.QUERY)
    return job


def comparison_response(gateway: GatewayContext, job: Job, map_name: str) -> SimilarityResponse:
    """Build the response from the result of a succeeded compare job.

    Raises:
        Gone: `query_expired`, if the result was deleted.
    """
    params = CompareJobParams.model_validate(job.params)
    try:
        data = gateway.store.get(comparison_key(job.id))
    except NotFound:
        raise query_expired_error() from None
    candidates = CompareResult.model_validate_json(data).candidates
    searched = {candidate.photo_id: candidate for candidate in params.request.candidates}
    with gateway.catalog.read() as session:
        photos = get_live_photos(session, searched)
    live = [candidate for candidate in candidates if candidate.photo_id in photos]
    assert job.finished_at is not None
    elapsed_ms = (job.finished_at - job.created_at).total_seconds() * 1000
    return params.frame.model_copy(
        update={"processing_time_ms": params.frame.processing_time_ms + elapsed_ms}
    ).with_photos(
        SimilarPhotoResponse.of(
            photos[candidate.photo_id],
            map_name,
            similarity_score=searched[candidate.photo_id].score,
            weighted_score=searched[candidate.photo_id].weighted_score,
            rerank_score=candidate.rerank_score,
            match_probability=params.match_probabilities.get(candidate.photo_id),
            explanation=candidate.explanation,
        )
        for candidate in live[: params.top_k]
    )


def _find_compare_job(session: Session, describe_job: Job) -> Job | None:
    job_id = describe_job.params.get(COMPARE_JOB_PARAM)
    return session.get(Job, UUID(job_id)) if job_id else None


def _build_compare_job(
    gateway: GatewayContext,
    query: SimilarityQuery,
    search_params: SearchParams,
    describe_job_id: UUID | None,
) -> tuple[Job, tuple[Search, ...]]:
    """Search, and build the compare job and the history row; neither is added to a session."""
    result = run_similarity_search(gateway, query, search_params)
    params = CompareJobParams(
        request=CompareRequest(
            query_photo_id=query.photo_id,
            query_job_id=describe_job_id,
            candidates=tuple(result.hits),
            rerank=search_params.rerank or 0,
            explain=search_params.top_k if search_params.explain else 0,
            word_weights=result.word_weights,
        ),
        top_k=search_params.top_k,
        frame=result.response_without_photos,
        match_probabilities=result.match_probabilities,
    )
    job = Job(
        id=new_id(),
        map_id=query.map.id,
        kind=JobKind.COMPARE,
        priority=Priority.QUERY,
        generation_id=query.generation.id,
        params=params.model_dump(mode="json"),
    )
    return job, result.history
