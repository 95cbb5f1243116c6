"""Answers whose first photos an extractor has looked at closely: `rerank=N` and `explain=true`.

The search tier is asked as always. What it finds becomes a compare job of the highest priority,
with the rest of the answer in its params; the call waits a while for it. The job's result is joined
with live photos anew, so that what was deleted meanwhile is in no answer.
"""

from __future__ import annotations

from uuid import UUID

from pydantic import BaseModel, ConfigDict
from sqlalchemy.orm import Session

from services.gateway.dependencies import GatewayContext
from services.gateway.idempotency import IdempotentRequest
from services.gateway.schemas import (
    ExplanationResponse,
    PhotoResponse,
    SimilarityResponse,
    SimilarPhotoResponse,
)
from services.gateway.search_params import SearchParams
from services.gateway.similarity_search import SimilarityQuery, run_similarity_search
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
    RerankCandidate,
    RerankedCandidate,
    check_explainable,
    check_rerankable,
    query_expired_error,
)
from shared.storage.keys import comparison_key

COMPARE_JOB_PARAM = "compare_job_id"
"""In the params of a describe job: the job that compares its photo."""


class CompareJobParams(BaseModel):
    """What a compare job carries: what is asked of the extractor, and the rest of the answer."""

    model_config = ConfigDict(frozen=True)

    request: CompareRequest
    top_k: int
    frame: SimilarityResponse


def check_comparison_supported(
    gateway: GatewayContext, map_name: str, search_params: SearchParams
) -> None:
    """Unprocessable (`not_rerankable`, `not_explainable`) for what the map's extractor can't do."""
    if not search_params.needs_comparison:
        return
    with gateway.catalog.read() as session:
        map_ = get_map(session, map_name)
        generation = active_generation(session, map_.id)
    recipe = gateway.settings.recipe(generation.extractor if generation else map_.extractor)
    if search_params.rerank is not None:
        check_rerankable(recipe)
    if search_params.explain:
        check_explainable(recipe, generation.spec if generation else None)


def start_comparison_of_stored_photo(
    gateway: GatewayContext,
    query: SimilarityQuery,
    search_params: SearchParams,
    idempotent: IdempotentRequest,
) -> Job:
    """Search for a stored photo, and queue the comparison."""
    job, history = _build_compare_job(gateway, query, search_params, None)
    with gateway.catalog.write() as session:
        session.add_all([job, history])
        session.flush()
        idempotent.store_job_response(session, job)
    gateway.hints.send(WakeupQueue.QUERY)
    return job


def start_comparison_of_query_photo(
    gateway: GatewayContext, describe_job: Job, query: SimilarityQuery, search_params: SearchParams
) -> Job:
    """The one comparison of a described query photo: the one that there is, or else a new one."""
    with gateway.catalog.read() as session:
        found = _find_compare_job(session, describe_job)
    if found is not None:
        return found
    job, history = _build_compare_job(gateway, query, search_params, describe_job.id)
    with gateway.catalog.write() as session:
        current = session.get(Job, describe_job.id, with_for_update=True, populate_existing=True)
        if current is None:
            raise query_expired_error()
        found = _find_compare_job(session, current)
        if found is not None:  # another call was first
            return found
        current.params = {**current.params, COMPARE_JOB_PARAM: str(job.id)}
        session.add_all([job, history])
    gateway.hints.send(WakeupQueue.QUERY)
    return job


def comparison_response(gateway: GatewayContext, job: Job, map_name: str) -> SimilarityResponse:
    """The answer of a compare job that has succeeded; Gone (`query_expired_error`) once it has
    gone."""
    params = CompareJobParams.model_validate(job.params)
    try:
        data = gateway.store.get(comparison_key(job.id))
    except NotFound:
        raise query_expired_error() from None
    candidates = CompareResult.model_validate_json(data).candidates
    scores = {one.photo_id: one for one in params.request.candidates}
    with gateway.catalog.read() as session:
        photos = get_live_photos(session, scores)
    live = [one for one in candidates if one.photo_id in photos]
    assert job.finished_at is not None
    took_ms = (job.finished_at - job.created_at).total_seconds() * 1000
    return params.frame.model_copy(
        update={"processing_time_ms": params.frame.processing_time_ms + took_ms}
    ).with_photos(
        SimilarPhotoResponse(
            similarity_score=scores[one.photo_id].score,
            weighted_score=scores[one.photo_id].weighted_score,
            rerank_score=one.rerank_score,
            explanation=_explanation_response(one),
            **PhotoResponse.fields_of(photos[one.photo_id], map_name),
        )
        for one in live[: params.top_k]
    )


def _find_compare_job(session: Session, describe_job: Job) -> Job | None:
    known = describe_job.params.get(COMPARE_JOB_PARAM)
    return session.get(Job, UUID(known)) if known else None


def _build_compare_job(
    gateway: GatewayContext,
    query: SimilarityQuery,
    search_params: SearchParams,
    describe_job_id: UUID | None,
) -> tuple[Job, Search]:
    """A job to be queued, and the history's row: of each question one, however often its answer is
    fetched."""
    found = run_similarity_search(gateway, query, search_params)
    params = CompareJobParams(
        request=CompareRequest(
            query_photo_id=query.photo_id,
            query_job_id=describe_job_id,
            candidates=tuple(
                RerankCandidate(
                    photo_id=hit.photo_id, score=hit.score, weighted_score=hit.weighted_score
                )
                for hit in found.hits
            ),
            rerank=search_params.rerank or 0,
            explain=search_params.top_k if search_params.explain else 0,
            word_weights=found.word_weights,
        ),
        top_k=search_params.top_k,
        frame=found.response_without_photos,
    )
    job = Job(
        id=new_id(),
        map_id=query.map_id,
        kind=JobKind.COMPARE,
        priority=Priority.QUERY,
        generation_id=query.generation.id,
        params=params.model_dump(mode="json"),
    )
    return job, found.history_row


def _explanation_response(candidate: RerankedCandidate) -> ExplanationResponse | None:
    return (
        ExplanationResponse.model_validate(candidate.explanation.model_dump())
        if candidate.explanation
        else None
    )
